"""`eval_info.json`: counts, rates and intervals under the keys of LeRobot after 0.6.1."""

from __future__ import annotations

import errno
import json
import os
from types import SimpleNamespace

import pytest

from lerobot_roborecover.analysis.stats.intervals import rate_interval, spread
from lerobot_roborecover.evaluation.eval_info import eval_info, success_counts
from tests.support.trial_rows import trial_row


def test_counts_stand_beside_every_rate():
    solved = {0: (True, True, False), 1: (False, False, False), 2: (True, True, True)}
    info = eval_info(
        [trial_row(n, k, ok) for n, trials in solved.items() for k, ok in enumerate(trials)], "suite"
    )
    assert set(info) == {"per_task", "per_group", "overall"}
    overall = info["overall"]
    assert (overall["n_success"], overall["n_episodes"]) == (5, 9)
    assert overall["pc_success"] == pytest.approx(500 / 9)
    low, high = rate_interval(spread([2 / 3, 0, 1]))
    assert overall["pc_success_ci95"] == pytest.approx([100 * low, 100 * high])
    assert sorted(t["n_success"] for t in info["per_task"]) == [0, 2, 3]
    assert all(t["n_episodes"] == 3 for t in info["per_task"])
    json.dumps(info, allow_nan=False)


def test_trials_of_one_scenario_are_no_further_scenarios():
    """Two scenarios with many trials each say little of other scenarios, however many trials there are."""
    low, high = success_counts([[1.0] * 50, [0.0] * 50])["pc_success_ci95"]
    assert high - low > 60
    low, high = success_counts([[1.0, 0.0] * 50])["pc_success_ci95"]
    assert high - low < 25


@pytest.mark.lerobot
def test_the_file_is_replaced_by_a_whole_one_or_not_at_all(tmp_path, monkeypatch, capsys):
    from lerobot_roborecover.evaluation import runner

    def full(number):
        raise OSError(errno.ENOSPC, "No space left on device")

    cfg = SimpleNamespace(
        folder=tmp_path, eval=SimpleNamespace(n_episodes=1), recovery_env=SimpleNamespace(group_by="suite")
    )
    run = SimpleNamespace(
        rows=lambda: [trial_row(0, 0, True)],
        require_log=lambda: SimpleNamespace(path=tmp_path / "trials.jsonl"),
    )
    scenarios = [SimpleNamespace(id=trial_row(0, 0, True).scenario_id)]
    (tmp_path / "eval_info.json").write_text("earlier")
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            runner.report(cfg, run, scenarios, [])
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("eval_info.json", "earlier")]
    runner.report(cfg, run, scenarios, [])
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_success"] == 1


def test_too_little_to_say_anything():
    assert success_counts([]) == {
        "pc_success": None, "pc_success_ci95": None, "n_success": 0, "n_episodes": 0,
    }  # fmt: skip
    assert success_counts([[1.0]])["pc_success_ci95"] is None
