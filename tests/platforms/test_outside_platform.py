"""A platform of another distribution, `examples/crane`: found, checked, and run through every command."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "crane"


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    """The environment of a process that has the example installed, as an installer would lay it out."""
    site = tmp_path_factory.mktemp("site")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    (module,) = EXAMPLE.glob("*.py")
    (site / module.name).write_text(module.read_text())
    info = site / f"roborecover_crane-{project['version']}.dist-info"
    info.mkdir()
    metadata = {"Metadata-Version": "2.1", "Name": project["name"], "Version": project["version"]}
    (info / "METADATA").write_text("".join(f"{k}: {v}\n" for k, v in metadata.items()))
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in names.items()) for group, names in groups]
    (info / "entry_points.txt").write_text("\n".join(lines))
    return {**os.environ, "PYTHONPATH": str(site)}


def test_the_page_leads_to_the_example_and_it_is_short():
    (module,) = EXAMPLE.glob("*.py")
    assert len(module.read_text().splitlines()) <= 200
    page = (EXAMPLE.parents[1] / "docs" / "platforms.md").read_text()
    assert f"](../examples/crane/{module.name})" in page


def test_it_keeps_the_contract(environment):
    program = [sys.executable, "-m", "lerobot_roborecover.cli.main", "check-platform", "crane", "--json"]
    done = subprocess.run(program, capture_output=True, text=True, env=environment)
    report = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert report["ok"]
    names = {check["name"] for check in report["checks"] if check["status"] == "ok"}
    assert {"to-the-ship: replay", "to-the-quay: replay in a fresh process", "imports of a worker"} < names


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_collect_screen_eval_and_report(environment, tmp_path):
    program = [sys.executable, "-m", "tests.support.outside_chain", str(tmp_path), "crane"]
    done = subprocess.run(program, capture_output=True, text=True, env=environment, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["candidates"] == 4
    assert found["lerobot_eval"] == found["roborecover_eval"]  # the same outcomes, to the step
    assert (len(found["lerobot_eval"]), len(found["tested"])) == (4, 3)
    assert {outcome for _, outcome, _ in found["lerobot_eval"]} <= {"success", "horizon"}
    page = next(tmp_path.glob("report/*.html")).read_text()
    assert re.search(r"crane", page)
