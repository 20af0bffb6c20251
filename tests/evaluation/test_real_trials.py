"""On real simulators a trial is the same in any batch, in worker processes or not, and after a resume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from tests.support.exactness import row_as_recorded
from tests.support.loop import evaluate, outcomes


def reach(observation: dict) -> np.ndarray:
    """(B, 4) deterministic Meta-World actions, each row from its own observation: over it, down, grip."""
    state = observation["environment_state"]
    hand, thing = state[:, :3], state[:, 4:7]
    over = np.linalg.norm(hand[:, :2] - thing[:, :2], axis=1, keepdims=True) > 0.02
    target = np.where(over, thing + np.array([0.0, 0.0, 0.1]), thing)
    grip = np.where(np.linalg.norm(hand - thing, axis=1, keepdims=True) < 0.03, 0.8, -1.0)
    return np.clip(np.concatenate([10.0 * (target - hand), grip], axis=1), -1, 1).astype(np.float32)


def press_on(observation: dict) -> np.ndarray:
    """(B, 7) deterministic LIBERO actions: towards a corner of the table, closing the hand."""
    position = observation["robot_state"]["eef"]["pos"]
    action = np.zeros((len(position), 7))
    action[:, :3] = 4.0 * (np.array([0.1, 0.2, 0.95]) - position)
    action[:, 6] = 1.0
    return np.clip(action, -1, 1).astype(np.float32)


def short(tmp_path, name: str, count: int, horizon: int):
    """The first scenarios of a shipped set, each with a small budget."""
    scenarios = load_scenarios(name)[:: len(load_scenarios(name)) // count][:count]
    return write_scenarios(
        tmp_path / "set", [replace(s, task=replace(s.task, horizon=horizon)) for s in scenarios]
    )


@pytest.mark.nightly
@pytest.mark.metaworld
@pytest.mark.slow
def test_metaworld(tmp_path):
    root = short(tmp_path, "metaworld_starter", 3, 20)
    kind = {"platform": "metaworld", "simulator": {"obs_type": "state"}, "policy": reach, "trials": 4}
    reference = outcomes(evaluate(root, tmp_path / "1.jsonl", batch=1, **kind))
    assert len(reference) == 12
    assert all(map(row_as_recorded, read_trial_log(tmp_path / "1.jsonl")))
    assert outcomes(evaluate(root, tmp_path / "2.jsonl", batch=2, workers=True, **kind)) == reference
    assert (
        outcomes(evaluate(root, tmp_path / "4.jsonl", batch=4, workers=True, reverse=True, **kind))
        == reference
    )
    evaluate(root, tmp_path / "r.jsonl", batch=3, stop_after_batches=2, **kind)
    assert outcomes(evaluate(root, tmp_path / "r.jsonl", batch=2, **kind)) == reference


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_libero(tmp_path):
    root = short(tmp_path, "libero_starter", 2, 25)
    kind = {"platform": "libero", "simulator": {"obs_type": "state"}, "policy": press_on, "trials": 2}
    reference = outcomes(evaluate(root, tmp_path / "1.jsonl", batch=1, **kind))
    assert len(reference) == 4
    assert all(map(row_as_recorded, read_trial_log(tmp_path / "1.jsonl")))
    assert outcomes(evaluate(root, tmp_path / "2.jsonl", batch=2, workers=True, **kind)) == reference
    evaluate(root, tmp_path / "r.jsonl", batch=1, stop_after_batches=1, **kind)
    assert outcomes(evaluate(root, tmp_path / "r.jsonl", batch=2, **kind)) == reference
