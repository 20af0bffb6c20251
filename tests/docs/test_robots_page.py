"""The evening of docs/robots.md, command by command, on the simulated lab; `tests/robot` has its parts."""

from __future__ import annotations

import os
import subprocess

import pytest

from tests.platforms.test_outside_platform import environment  # noqa: F401 - a fixture
from tests.support.doc_blocks import ROOT, blocks_of


@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.nightly
def test_the_whole_evening_runs_on_the_simulated_lab(environment, tmp_path):  # noqa: F811
    (block,) = [b for b in blocks_of(ROOT / "docs" / "robots.md") if "robot.lab.scripted" in b.code]
    paths = os.pathsep.join([str(ROOT), environment["PYTHONPATH"]])
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.code],
        cwd=tmp_path,
        env={**environment, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    out = tmp_path / "outputs/lab"
    assert len((out / "run/trials.jsonl").read_text().splitlines()) == 32
    assert (out / "report/report.html").exists()
    assert "is separated from the other policy" in done.stdout, "the evening ends with a verdict"
