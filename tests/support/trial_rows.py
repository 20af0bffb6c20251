"""Trial rows made up for the analysis: no simulator, no policy, any size."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

import numpy as np

from lerobot_roborecover.logs.fields import TRIAL_SCHEMA
from lerobot_roborecover.logs.row import TrialRow

CELLS = [
    ("Approach", "Wrong Pose"),
    ("Approach", "Wrong Target"),
    ("Contact", "Wrong Pose"),
    ("Place", "Scene Change"),
]


def trial_row(scenario: int | str, trial: int = 0, success: bool = True, **changes) -> TrialRow:
    """One row; what is not said follows from the scenario's number."""
    index = scenario if isinstance(scenario, int) else 0
    name = f"s{scenario:03d}" if isinstance(scenario, int) else scenario
    stage, deviation = CELLS[index % len(CELLS)]
    outcome = changes.pop("outcome", "success" if success else "horizon")
    start = changes.get("start", "recovery")
    policy = changes.get("policy", "alpha@1")
    horizon = changes.get("horizon", 300)
    steps = horizon if outcome == "horizon" else min(100, horizon)
    values = {
        "schema": TRIAL_SCHEMA, "scenario_id": name, "scenario_sha256": f"{index:064x}", "dataset": "made-up",
        "dataset_revision": "r1", "platform": "libero", "suite": ("libero_goal", "libero_10")[index % 2],
        "task": f"task-{index % 5}", "instruction": "put the bowl on the plate", "stage": stage,
        "deviation": deviation, "source": ("natural", "perturbed")[index % 3 == 2],
        "source_policy": ("alpha", "beta")[index % 2], "cluster": "", "split": "test", "start": start,
        "rewind_steps": 0, "handoff_step": 40, "trial": trial, "run_seed": 1000, "trial_seed": trial,
        "noise": "per_trial", "batch_size": 1, "outcome": outcome, "success": outcome == "success",
        "reason": "" if outcome in ("success", "horizon") else "made up", "steps": steps, "horizon": horizon,
        "handoff_eef_error_mm": 0.0, "handoff_object_error_mm": 0.0, "handoff_identical": True,
        "handoff_from_snapshot": True, "handoff_s": 0.1, "sim_s": 1.0, "policy_s": 1.0, "actions_sha256": "",
        "interventions": [], "options": {"obs_type": "pixels"}, "policy": policy, "execution_horizon": 10,
        "versions": {"lerobot": "0.6.1", "mujoco": "3.3.2"}, "config_hash": f"{policy}/{start}",
        "finished_at": "2026-01-02T03:04:05.000+00:00", "progress": None,
        "first_state": sha256(name.encode()).hexdigest(), "policy_settings": {},
    }  # fmt: skip
    return TrialRow(**(values | changes))


def policy_rows(
    policy: str, count: int, trials: int, rate: float, seed: int, start: str = "recovery", **changes
) -> list[TrialRow]:
    """A policy on `count` scenarios, whose difficulty scatters around `rate`."""
    rng = np.random.default_rng(seed)
    rows = []
    for scenario in range(count):
        p = float(np.clip(rate + rng.normal(0, 0.3), 0.02, 0.98))
        for trial in range(trials):
            success = bool(rng.uniform() < p)
            steps = int(rng.integers(20, 250)) if success else 300
            rows.append(
                trial_row(scenario, trial, success, steps=steps, policy=policy, start=start, **changes)
            )
    return rows


def write_log(path: Path, rows: Iterable[TrialRow]) -> Path:
    """A log file of the rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(asdict(row)) + "\n" for row in rows), encoding="utf-8")
    return path


def three_policies(folder: Path, count: int = 60, trials: int = 5) -> list[str]:
    """Logs of three policies, two of them with an initial arm, one trial invalid."""
    settings: Sequence[tuple[str, float, float | None]] = [
        ("alpha@1", 0.35, 0.95), ("beta@2", 0.65, 0.8), ("gamma@3", 0.6, None),
    ]  # fmt: skip
    logs = []
    for seed, (policy, rate, initial) in enumerate(settings):
        rows = policy_rows(policy, count, trials, rate, seed)
        if initial is not None:
            rows += policy_rows(policy, count, 3, initial, seed + 10, start="initial")
        logs.append(str(write_log(folder / f"{policy.split('@')[0]}.jsonl", rows)))
    return logs
