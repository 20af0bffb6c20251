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


class ResamplingUnit(StrEnum):
    """What an interval takes as independent."""

    SCENARIO = "scenario"
    TRAJECTORY = "trajectory"
    """Scenarios cut from one trajectory belong together; one without a cluster is its own."""
    TASK = "task"


WORDS = {
    ResamplingUnit.SCENARIO: "scenarios",
    ResamplingUnit.TRAJECTORY: "trajectory clusters",
    ResamplingUnit.TASK: "tasks",
}
"""What is resampled, in the plural."""
ESTIMAND = {
    ResamplingUnit.SCENARIO: "other scenarios like these, of these tasks",
    ResamplingUnit.TRAJECTORY: "scenarios of other trajectories like these, of these tasks",
    ResamplingUnit.TASK: "scenarios of other tasks like these",
}
"""What the intervals speak of."""


def default_unit(platform: str) -> ResamplingUnit:
    """What is resampled on a platform where nobody says otherwise (paper, appendix "Statistical analysis"):
    trajectory clusters where several scenarios come of one trajectory, else scenarios."""
    try:
        return ResamplingUnit.TRAJECTORY if platform_named(platform).clustered else ResamplingUnit.SCENARIO
    except ScenarioError:  # logs are read on machines that do not have their platform
        return ResamplingUnit.SCENARIO


def unit_labels(
    unit: ResamplingUnit, ids: Sequence[str], clusters: Sequence[str], tasks: Sequence[str]
) -> np.ndarray:
    """(N,) str: scenarios with the same label are one unit.

    Args:
        unit: which.
        ids: N scenario ids.
        clusters: N trajectory clusters; empty where a scenario has none.
        tasks: N tasks, told apart across suites.
    """
    if unit is ResamplingUnit.TASK:
        return np.array([f"task:{t}" for t in tasks], dtype=str)
    if unit is ResamplingUnit.TRAJECTORY:
        named = [f"cluster:{c}" if c else f"scenario:{i}" for i, c in zip(ids, clusters, strict=True)]
        return np.array(named, dtype=str)
    return np.array([f"scenario:{i}" for i in ids], dtype=str)
