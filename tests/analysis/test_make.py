"""What a report costs its caller: no simulator, no LeRobot, and no garbage that stays."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest

from lerobot_roborecover.analysis.make import report
from lerobot_roborecover.analysis.options import Options
from tests.support.trial_rows import policy_rows, write_log


@pytest.mark.slow
def test_reading_logs_needs_no_simulator_and_no_lerobot(tmp_path):
    path = str(write_log(tmp_path / "trials.jsonl", policy_rows("a", 4, 2, 0.5, 0)))
    code = (
        "import sys; from lerobot_roborecover.cli.main import main; "
        f"status = main(['report', {path!r}, '--out', {str(tmp_path / 'out')!r}, '--draws', '100']); "
        "print(sorted({'torch', 'lerobot', 'mujoco'} & set(sys.modules))); sys.exit(status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_a_report_leaves_the_garbage_collector_as_it_was(tmp_path):
    """It is called from training loops, too: what is garbage then must not stay for ever."""
    log = write_log(tmp_path / "log.jsonl", policy_rows("p", 8, 1, 0.5, 0))
    before = gc.get_freeze_count()
    report(log, tmp_path / "out", options=Options(draws=100))
    assert gc.get_freeze_count() == before
