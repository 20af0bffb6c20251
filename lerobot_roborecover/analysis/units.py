"""What is taken as drawn at random: scenarios, trajectories with all their scenarios, or tasks with all
theirs.

This is the one place that says so. Everything that has an interval or a p-value asks here.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError


class Unit(StrEnum):
    """What an interval takes as independent."""

    SCENARIO = "scenario"
    TRAJECTORY = "trajectory"
    """Scenarios cut from one trajectory belong together; one without a cluster is its own."""
    TASK = "task"


WORDS = {Unit.SCENARIO: "scenarios", Unit.TRAJECTORY: "trajectory clusters", Unit.TASK: "tasks"}
"""What is resampled, in the plural."""
ESTIMAND = {
    Unit.SCENARIO: "other scenarios like these, of these tasks",
    Unit.TRAJECTORY: "scenarios of other trajectories like these, of these tasks",
    Unit.TASK: "scenarios of other tasks like these",
}
"""What the intervals speak of."""


def default_unit(platform: str) -> Unit:
    """What is resampled on a platform where nobody says otherwise (paper, appendix "Statistical analysis"):
    trajectory clusters where several scenarios come of one trajectory, else scenarios."""
    try:
        return Unit.TRAJECTORY if platform_named(platform).clustered else Unit.SCENARIO
    except ScenarioError:  # logs are read on machines that do not have their platform
        return Unit.SCENARIO


def unit_labels(unit: Unit, ids: Sequence[str], clusters: Sequence[str], tasks: Sequence[str]) -> np.ndarray:
    """(N,) str: scenarios with the same label are one unit.

    Args:
        unit: which.
        ids: N scenario ids.
        clusters: N trajectory clusters; empty where a scenario has none.
        tasks: N tasks, told apart across suites.
    """
    if unit is Unit.TASK:
        return np.array([f"task:{t}" for t in tasks], dtype=str)
    if unit is Unit.TRAJECTORY:
        named = [f"cluster:{c}" if c else f"scenario:{i}" for i, c in zip(ids, clusters, strict=True)]
        return np.array(named, dtype=str)
    return np.array([f"scenario:{i}" for i in ids], dtype=str)
