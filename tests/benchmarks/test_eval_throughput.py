"""The throughput on paper: within its bounds, and LeRobot's loop as worked by hand."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch):
    """On the path for one test: numba asks for the library `coverage`, and the folder has a namesake."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))


def times(**changes):
    from eval_throughput import Times

    usual = {"step_s": 0.012, "look_s": 0.010, "fixed_s": 0.073, "each_s": 0.002, "cores": 4, "executed": 10}
    return Times(**{**usual, "horizon": 60, "max_batch": 64, **changes})


@pytest.mark.parametrize(("slots", "limit"), [(2, "too few simulators"), (24, "cores")])
def test_nothing_is_faster_than_cores_and_policy(slots, limit):
    from eval_throughput import of_engine, of_lock_step

    found = of_engine(slots, times(), trials=4)
    # A chunk is ten steps and a look, and at best shares its inference with all others.
    assert found.steps_per_s < 1.05 * 10 * times().cores / 0.130
    assert found.steps_per_s < 10 * found.batch / (0.073 + 0.002 * found.batch)
    assert found.limit == limit
    assert found.steps_per_s > 1.1 * of_lock_step(slots, times())


def test_a_slow_policy_is_the_limit():
    from eval_throughput import of_engine

    slow = times(
        step_s=0.001, look_s=0.0, fixed_s=0.2, each_s=0.05, cores=32, executed=2, horizon=20, max_batch=4
    )
    assert of_engine(32, slow, trials=4).limit == "policy"


def test_lock_step_by_hand():
    from eval_throughput import JITTER, of_lock_step

    one = of_lock_step(1, times())
    assert one == pytest.approx(1 / (0.022 + 0.075 / 10))
    # Eight environments on four cores take two turns, and the slowest of each is waited for.
    slowest = 1 + JITTER * 1.2206
    assert of_lock_step(8, times()) == pytest.approx(8 / (0.044 * slowest + 0.089 / 10), rel=1e-4)
    # A hundred in two batches.
    wide = of_lock_step(100, times())
    assert wide < 100 / (0.022 * 25 + (2 * 0.073 + 0.2) / 10)
