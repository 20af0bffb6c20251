"""Another LeRobot than the known one: what is said, and how its tests are set up."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lerobot_roborecover.platforms import all_platforms, versions

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_known_lerobot_is_the_pinned_one():
    asked = [one for few in PROJECT["optional-dependencies"].values() for one in few]
    asked += PROJECT["dependencies"]
    pins = {m[1] for one in asked if (m := re.fullmatch(r"lerobot\[[\w,]+\]==(.+)", one))}
    assert pins == {versions.LEROBOT}
    for platform in all_platforms():
        if platform.required_versions.get("lerobot"):
            assert platform.required_versions["lerobot"] == (versions.LEROBOT,), platform.name


@pytest.mark.parametrize(("found", "said"), [("0.6.2", "this is LeRobot 0.6.2"), (None, "not installed")])
def test_another_one_is_told_in_one_line_with_the_remedy(found, said, monkeypatch):
    monkeypatch.setattr(versions, "installed", lambda name: found)
    note = versions.lerobot_note()
    assert said in note
    assert "\n" not in note
    assert "pip install 'lerobot==0.6.1'" in note
    monkeypatch.setattr(versions, "installed", lambda name: versions.LEROBOT)
    assert versions.lerobot_note() is None


def test_it_is_told_before_anything_of_lerobot_is_imported(monkeypatch, caplog):
    monkeypatch.setattr(versions, "installed", lambda name: "99.0")
    monkeypatch.delitem(sys.modules, "lerobot_env_roborecover", raising=False)
    # As where the plugin cannot be imported any more.
    monkeypatch.setitem(sys.modules, "lerobot_roborecover.plugin", None)
    with caplog.at_level(logging.WARNING), pytest.raises(ImportError):
        __import__("lerobot_env_roborecover")
    assert "this is LeRobot 99.0" in caplog.text


def test_extras_of_a_source_tree(tmp_path):
    (tmp_path / "pyproject.toml").write_text(
        '[project]\nname = "lerobot"\n[project.optional-dependencies]\n'
        'dataset = ["datasets>=4", "lerobot[av-dep]"]\nav-dep = ["av>=15"]\nlibero = ["lerobot[dataset]"]\n'
        'robots = ["lerobot[motors]"]\nmotors = []\n'
    )
    out = subprocess.run(
        [sys.executable, ROOT / "scripts" / "lerobot_extras.py", tmp_path],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert out.stdout.strip() == "av-dep,dataset,libero"


@pytest.mark.parametrize("script", ["setup.sh", "test.sh"])
def test_what_is_no_source_tree_is_refused_before_anything_is_done(script, tmp_path):
    found = subprocess.run(
        [ROOT / "scripts" / script, "--lerobot-main", tmp_path], capture_output=True, text=True, check=False
    )
    assert found.returncode == 1
    assert "no source tree of LeRobot" in found.stderr
    assert "git clone" in found.stderr
