"""Numbers of single trials, averaged per policy: the place where a metric of one's own is added.

A metric is a function of a trial row. It becomes a column of the table "Measured in the trials": the mean of
the scenarios' means, each scenario counting the same, with an interval over what is independent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling
from lerobot_roborecover.logs.row import TrialRow

NONE = float("nan")
"""Value of a trial that a metric says nothing of."""


@dataclass(frozen=True)
class Metric:
    """One number of a trial."""

    title: str
    """Title of the column, with its unit."""
    of: Callable[[TrialRow], float]
    """The trial's value; `NONE` leaves the trial out."""
    share: bool
    """Values are from 0 to 1: shown in per cent, with the interval that rates have. Others have the
    percentile bootstrap's."""
    about: str
    """A sentence for those who read the table."""
    optional: bool = False
    """Left out of tables where no trial has a value."""


def _horizon_used(row: TrialRow) -> float:
    return min(row.steps / row.horizon, 1.0) if row.horizon else NONE


def _steps_to_recover(row: TrialRow) -> float:
    return float(row.steps) if row.success else NONE


def _best_progress(row: TrialRow) -> float:
    return max(row.progress) / 100 if row.progress else NONE


def _drawdown(row: TrialRow) -> float:
    """Largest fall below the best so far."""
    if not row.progress:
        return NONE
    shares = np.asarray(row.progress) / 100
    return float((np.maximum.accumulate(shares) - shares).max())


def _steps_to_lasting_progress(row: TrialRow) -> float:
    """First step from which on it never is as far from the goal again as at the handoff."""
    if not row.progress or row.progress[-1] <= row.progress[0]:
        return NONE
    back = np.flatnonzero(np.asarray(row.progress) <= row.progress[0])
    return float(back[-1] + 1)


METRICS = (
    Metric("Horizon used %", _horizon_used, True, "Horizon used: new steps over the scenario's horizon."),
    Metric(
        "Steps to recover",
        _steps_to_recover,
        False,
        "Steps to recover: new steps of successful trials.",
    ),
    Metric(
        "Best progress %",
        _best_progress,
        True,
        "Best progress: the most of the task that was done at any step, failures included (partial credit; "
        "docs/report.md says what a platform takes for progress).",
        optional=True,
    ),
    Metric(
        "Drawdown %",
        _drawdown,
        True,
        "Drawdown: the largest fall of progress below the best that the trial had reached by then.",
        optional=True,
    ),
    Metric(
        "Steps to lasting progress",
        _steps_to_lasting_progress,
        False,
        "Steps to lasting progress: new steps until progress is above that of the handoff for good; trials "
        "that end no further than they began are left out.",
        optional=True,
    ),
)
"""Columns, in this order."""


def scenario_means(panel: Panel, metric: Metric) -> np.ndarray:
    """(N, P) means of a metric's values; NaN where no trial of the scenario has one."""
    found = np.full((len(panel.scenarios), len(panel.arms)), np.nan)
    for (p, n), rows in panel.rows.items():
        values = np.array([metric.of(row) for row in rows], float)
        if np.isfinite(values).any():
            found[n, p] = np.nanmean(values)
    return found


def metric_estimates(panel: Panel, metric: Metric, draws: Resampling) -> list[Estimate]:
    """A metric's mean for every arm, with its interval.

    Args:
        panel: trials of P arms.
        metric: which.
        draws: of the panel's scenarios.
    """
    values = scenario_means(panel, metric)
    return draws.rates(values) if metric.share else draws.percentile(values)
