"""Another LeRobot than the known one: what is said, and how its tests are set up."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lerobot_roborecover.doctor.software import check_versions
from lerobot_roborecover.platforms import all_platforms, versions
from lerobot_roborecover.platforms.findings import Status
from lerobot_roborecover.utils import lerobot_versions

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_lerobot_has_a_lower_bound_alone_and_the_tested_one_is_in_the_constraints():
    asked = [one for few in PROJECT["optional-dependencies"].values() for one in few]
    asked += PROJECT["dependencies"]
    pins = {m[1] for one in asked if (m := re.fullmatch(r"lerobot\[[\w,]+\](.+)", one))}
    assert pins == {f">={lerobot_versions.OLDEST}"}
    assert f"lerobot=={lerobot_versions.OLDEST}" in (ROOT / "constraints.txt").read_text().splitlines()
    for platform in all_platforms():
        if platform.required_versions.get("lerobot"):
            assert platform.required_versions["lerobot"] == (lerobot_versions.OLDEST,), platform.name


@pytest.mark.parametrize(("found", "said"), [("0.6.0", "lerobot is 0.6.0"), (None, "not installed")])
def test_an_older_one_is_told_in_one_line_with_the_remedy(found, said):
    note = lerobot_versions.version_problem(found)
    assert said in note
    assert "\n" not in note
    assert "pip install 'lerobot>=0.6.1'" in note


@pytest.mark.parametrize("found", ["0.6.1", "0.6.2", "0.7.0", "1.0.0.dev1"])
def test_a_newer_one_is_recorded_and_not_refused(found, monkeypatch):
    here = {"lerobot": found, "mujoco": "3.3.2", "metaworld": "3.0.0"}
    monkeypatch.setattr(versions, "installed", here.get)
    assert lerobot_versions.version_problem(found) is None
    assert versions.version_problems("metaworld") == []
    (check,) = (c for c in check_versions("metaworld", True) if c.name.endswith("lerobot"))
    assert (check.status, found in check.detail) == (Status.OK, True)
    assert all(tested in check.detail for tested in lerobot_versions.TESTED)
    here["mujoco"] = "3.4.0"
    assert len(versions.version_problems("metaworld")) == 1, "physics is"


def test_it_is_told_before_anything_of_lerobot_is_imported(monkeypatch, caplog):
    monkeypatch.setattr(lerobot_versions.metadata, "version", lambda name: "0.5")
    monkeypatch.delitem(sys.modules, "lerobot_env_roborecover", raising=False)
    # As where the plugin cannot be imported any more.
    monkeypatch.setitem(sys.modules, "lerobot_roborecover.plugin", None)
    with caplog.at_level(logging.WARNING), pytest.raises(ImportError):
        __import__("lerobot_env_roborecover")
    assert "lerobot is 0.5;" in caplog.text


def test_every_platform_has_the_stamp_in_its_rows():
    for platform in all_platforms():
        assert versions.row_versions(platform.name)["lerobot"] == versions.installed("lerobot"), platform.name


@pytest.mark.lerobot
def test_what_is_to_be_removed_is_what_the_oldest_lerobot_lacks():
    """Fails where the tests' LeRobot is raised to one that has them: then what is ours goes."""
    if versions.installed("lerobot") == lerobot_versions.OLDEST:
        assert [one.lerobots for one in lerobot_versions.REPLACED if one.there()] == []
    else:
        assert all(isinstance(one.there(), bool) for one in lerobot_versions.REPLACED)
    for one in lerobot_versions.REPLACED:
        for file in re.findall(r"[\w/]+\.py", one.ours):
            assert (ROOT / "lerobot_roborecover" / file).is_file(), file


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
