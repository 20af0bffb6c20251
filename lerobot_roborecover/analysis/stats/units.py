"""What is taken as drawn at random: scenarios, trajectories with all their scenarios, first states with all
theirs, or tasks with all theirs.

This is the one place that says so. Everything that has an interval or a p-value asks here. Scenarios that
branch off from one first state have the same initial-state trial, so first states are the units of
initial-state trials, and of everything that holds them against recovery trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError


class ResamplingUnit(StrEnum):
    """What an interval takes as independent."""

    SCENARIO = "scenario"
    TRAJECTORY = "trajectory"
    """Scenarios cut from one trajectory belong together; one without a cluster is its own."""
    FIRST_STATE = "first_state"
    """Scenarios that branch off from one first state of their task belong together."""
    TASK = "task"


WORDS = {
    ResamplingUnit.SCENARIO: "scenarios",
    ResamplingUnit.TRAJECTORY: "trajectory clusters",
    ResamplingUnit.FIRST_STATE: "first states",
    ResamplingUnit.TASK: "tasks",
}
"""What is resampled, in the plural."""
ESTIMAND = {
    ResamplingUnit.SCENARIO: "other scenarios like these, of these tasks",
    ResamplingUnit.TRAJECTORY: "scenarios of other trajectories like these, of these tasks",
    ResamplingUnit.FIRST_STATE: "scenarios of other first states like these, of these tasks",
    ResamplingUnit.TASK: "scenarios of other tasks like these",
}
"""What the intervals speak of."""


def default_unit(platform: str) -> ResamplingUnit:
    """Returns a platform's default resampling unit (paper, appendix "Statistical analysis").

    The unit is the trajectory cluster where several scenarios come from one trajectory, else the scenario.
    """
    try:
        return ResamplingUnit.TRAJECTORY if platform_named(platform).clustered else ResamplingUnit.SCENARIO
    except ScenarioError:  # logs are read on machines that do not have their platform
        return ResamplingUnit.SCENARIO


def initial_unit(asked: ResamplingUnit | None) -> ResamplingUnit:
    """Returns what is resampled of initial-state trials: first states, or tasks where these were asked for.

    Args:
        asked: for recovery trials; None leaves it to the platform.
    """
    return ResamplingUnit.TASK if asked is ResamplingUnit.TASK else ResamplingUnit.FIRST_STATE


def first_state_label(first_state: str, cluster: str, scenario_id: str) -> str:
    """Returns the label of a scenario's first state.

    Args:
        first_state: its hash; empty where the row does not say it.
        cluster: trajectory cluster, which has one first state; empty where there is none.
        scenario_id: stands in for both.
    """
    return f"state:{first_state}" if first_state else _cluster_label(cluster, scenario_id)


def unit_labels(
    unit: ResamplingUnit,
    ids: Sequence[str],
    clusters: Sequence[str],
    tasks: Sequence[str],
    first_states: Sequence[str] = (),
) -> np.ndarray:
    """(N,) str: scenarios with the same label are one unit.

    Args:
        unit: which.
        ids: N scenario ids.
        clusters: N trajectory clusters; empty where a scenario has none.
        tasks: N tasks, distinguished across suites.
        first_states: N hashes of first states, empty where one is not known; none takes all for unknown.
    """
    if unit is ResamplingUnit.TASK:
        return np.array([f"task:{t}" for t in tasks], dtype=str)
    if unit is ResamplingUnit.FIRST_STATE:
        known = first_states or [""] * len(ids)
        return np.array([first_state_label(*n) for n in zip(known, clusters, ids, strict=True)], dtype=str)
    if unit is ResamplingUnit.TRAJECTORY:
        return np.array([_cluster_label(c, i) for i, c in zip(ids, clusters, strict=True)], dtype=str)
    return np.array([f"scenario:{i}" for i in ids], dtype=str)


def _cluster_label(cluster: str, scenario_id: str) -> str:
    return f"cluster:{cluster}" if cluster else f"scenario:{scenario_id}"
