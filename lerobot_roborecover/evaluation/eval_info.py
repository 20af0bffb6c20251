"""`eval_info.json` as `lerobot-eval` lays it out, made from trial rows."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import rate_interval, spread
from lerobot_roborecover.evaluation.session import group_name
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import RowLog
from lerobot_roborecover.utils.outputs import OutputExistsError


def eval_info(
    rows: Sequence[TrialRow], group_by: str, videos: Mapping[tuple[str, int], str] | None = None
) -> dict:
    """The trials in the layout of `lerobot-eval`'s `eval_info.json`.

    Args:
        rows: of one protocol.
        group_by: `suite`, `cell` or `source`.
        videos: files by scenario and trial.
    """
    files = videos or {}
    tasks: dict[tuple[str, str], list[TrialRow]] = defaultdict(list)
    for row in rows:
        tasks[group_name(row, group_by), row.scenario_id].append(row)
    per_task, groups = [], defaultdict(list)
    for (group, scenario_id), trials in sorted(tasks.items()):
        successes = [t.success for t in sorted(trials, key=lambda t: t.trial)]
        rewards = [float(s) for s in successes]
        paths = [files[scenario_id, t.trial] for t in trials if (scenario_id, t.trial) in files]
        metrics = {
            "sum_rewards": rewards,
            "max_rewards": rewards,
            "successes": successes,
            "video_paths": paths,
        }
        per_task.append(
            {"task_group": group, "task_id": scenario_id, "metrics": metrics, **success_counts([rewards])}
        )
        groups[group].append(rewards)

    def aggregate(scenarios: list[list[float]]) -> dict:
        rewards = [r for trials in scenarios for r in trials]
        mean = float(np.mean(rewards)) if rewards else None
        return {
            "avg_sum_reward": mean, "avg_max_reward": mean, **success_counts(scenarios), "video_paths": [],
        }  # fmt: skip

    return {
        "per_task": per_task,
        "per_group": {group: aggregate(scenarios) for group, scenarios in groups.items()},
        "overall": aggregate([trials for scenarios in groups.values() for trials in scenarios]),
    }


def check_eval_info(path: Path, log: RowLog) -> None:
    """Checks that a run whose log has no trial of it yet replaces no other run's results.

    Results whose trials are in the log are replaced: such as those of the same policy before its
    normalisation statistics were corrected.

    Args:
        path: `eval_info.json` that the run will write.
        log: the run's trial log.

    Raises:
        OutputExistsError: the file holds episodes that are not in the log, or is something else.
    """
    if not path.exists() and not path.is_symlink():
        return
    logged = {row.scenario_id for row in log.rows}
    try:
        kept = all(task["task_id"] in logged for task in json.loads(path.read_bytes())["per_task"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        kept = False
    if not kept:
        raise OutputExistsError(
            f"{path} holds the results of another run, whose trials are not in {log.path}. Name another "
            "--output_dir, or move the file away"
        )


def success_counts(scenarios: list[list[float]]) -> dict:
    """Counts, rate and interval in per cent, under the keys of LeRobot after 0.6.1.

    The interval is the one of all our tables, over scenarios, since trials of one scenario are alike; of a
    single scenario it is over its trials. None where a single trial, or none, says nothing.

    Args:
        scenarios: each one's trials, 1.0 for a success.
    """
    trials = [t for own in scenarios for t in own]
    units = [[t] for t in trials] if len(scenarios) == 1 else scenarios
    bounds = None
    if len(units) > 1:
        found = spread(
            np.array([np.mean(own) for own in units]), weights=np.array([float(len(own)) for own in units])
        )
        bounds = [100 * float(bound) for bound in rate_interval(found)]
    return {
        "pc_success": 100 * sum(trials) / len(trials) if trials else None,
        "pc_success_ci95": bounds,
        "n_success": int(sum(trials)),
        "n_episodes": len(trials),
    }
