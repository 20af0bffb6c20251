"""Time to recover: how RSR grows with the step budget, from trials run at the full one.

A trial that succeeded at step s would have succeeded with any budget of at least s, because a policy is not
informed of its budget; so one evaluation gives the RSR at every smaller budget.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling

FRACTIONS = (0.25, 0.5, 0.75, 1.0)
"""Budgets shown in the table, as shares of each scenario's horizon."""


def rates_within(
    panel: Panel, budgets: Sequence[float] | np.ndarray, *, of_horizon: bool = True
) -> np.ndarray:
    """Scenario rates with a smaller budget.

    Args:
        panel: the trials.
        budgets: B budgets: shares of each scenario's horizon, or steps.
        of_horizon: whether they are shares.

    Returns:
        (P, N, B) in [0, 1]; NaN where there are no trials.
    """
    horizons = np.array([s.horizon for s in panel.scenarios], float)
    limits = np.outer(horizons, budgets) if of_horizon else np.tile(budgets, (len(horizons), 1))
    counts = np.zeros((*panel.trials.shape, len(budgets)))
    for (p, n), rows in panel.rows.items():
        solved = np.array([row.steps for row in rows if row.success], float)
        # 0.5 * 45 steps allows 22 whole steps; rounding noise in the product must not cost one.
        counts[p, n] = (solved[:, None] <= np.floor(limits[n] + 1e-9)[None]).sum(0)
    trials = panel.trials[..., None].astype(float)
    return np.divide(counts, trials, out=np.full(counts.shape, np.nan), where=trials > 0)


def budget_estimates(
    panel: Panel, budgets: Sequence[float] | np.ndarray, resampling: Resampling, *, of_horizon: bool = True
) -> list[list[Estimate]]:
    """RSR of every policy at every budget, with intervals: P lists of B estimates."""
    rates = rates_within(panel, budgets, of_horizon=of_horizon)
    return [resampling.rates(rates[p]) for p in range(len(rates))]


def median_steps(panel: Panel) -> list[float]:
    """Median steps of every policy's successful trials; NaN for a policy without one."""
    steps: list[list[int]] = [[] for _ in panel.arms]
    for (p, _), rows in panel.rows.items():
        steps[p] += [row.steps for row in rows if row.success]
    return [float(np.median(s)) if s else float("nan") for s in steps]
