"""Where the uncertainty of an RSR comes from, scenarios or trials, and what more of either would buy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VarianceSplit:
    """Components of one policy's RSR; NaN where the trials cannot tell.

    With N scenarios, K_i trials of scenario i and p_i its true rate: the variance of an observed rate is the
    variance of p between scenarios plus, on average, E[p (1 - p) / K] within them.
    """

    scenarios: int
    trials: float
    """Harmonic mean of the trials per scenario."""
    between: float
    """Variance of the true rates between scenarios, from zero up."""
    within: float
    """Mean variance of one trial within a scenario."""
    standard_error: float
    """Standard error of the RSR as measured, for scenarios drawn from a population of such scenarios."""
    one_more_trial: float
    """The standard error with one more trial of every scenario (N more trials)."""
    one_more_scenario: float
    """The standard error with one more scenario, at as many trials."""
    same_cost_scenarios: float
    """The standard error with N more trials spent on N / K new scenarios instead: the fair rival of
    `one_more_trial`."""


def variance_split(successes: np.ndarray, trials: np.ndarray) -> VarianceSplit:
    """Method-of-moments split, unbiased in both components before the floor at zero.

    Args:
        successes: (N,) int.
        trials: (N,) int; scenarios without trials are left out.
    """
    run = trials > 0
    y, k = successes[run].astype(float), trials[run].astype(float)
    n = len(k)
    nan = float("nan")
    if not n:
        return VarianceSplit(0, nan, nan, nan, nan, nan, nan, nan)
    rate = y / k
    total = float(rate.var(ddof=1)) if n > 1 else nan
    repeated = k > 1
    effective = float(n / (1 / k).sum())
    if not repeated.any():
        error = float(np.sqrt(total / n)) if n > 1 else nan
        one_more = float(np.sqrt(total / (n + 1))) if n > 1 else nan
        return VarianceSplit(n, effective, nan, nan, error, nan, one_more, nan)
    within = float((rate * (1 - rate) * k / np.maximum(k - 1, 1))[repeated].mean())
    between = max(0.0, total - within / effective) if n > 1 else nan

    def error(scenarios: float, per_scenario: float) -> float:
        return float(np.sqrt((between + within / per_scenario) / scenarios))

    return VarianceSplit(
        n,
        effective,
        between,
        within,
        float(np.sqrt(total / n)) if n > 1 else nan,
        error(n, effective + 1),
        error(n + 1, effective),
        error(n + n / effective, effective),
    )
