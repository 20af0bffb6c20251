"""How far robots' trials started from their recovery points, and whether that moved the verdicts.

The slope is that of a logistic regression of success on the start error with an intercept for each policy, so
that a policy which happened to get the worse starts is not mistaken for an effect of the starts. A policy
whose verdicts are all alike says nothing of the slope and is left out. It is fitted by maximum likelihood
(Newton's method) with Wald intervals; where the data separate, there is no estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from lerobot_roborecover.analysis.stats.intervals import UNDEFINED, Estimate
from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.row import TrialRow

MEASURES = (("joint", "joint, units"), ("background_px", "camera, px"), ("object_px", "objects, px"))
"""Of a start, the worst over joints or cameras, and what a column calls it."""
_ITERATIONS, _STEP = 50, 1e-8
_SEPARATED = 30.0
"""Log-odds beyond which the likelihood has no maximum."""


_LEAST_TRIALS = 4


@dataclass(frozen=True)
class VerdictSlope:
    """How the verdict went with the start error."""

    estimate: Estimate
    """Change of the log-odds of success per unit."""
    trials: int
    """That it is fitted to."""
    reason: str = ""
    """Why there is no estimate."""


@dataclass(frozen=True)
class StartSummary:
    """Starts of one policy's trials."""

    trials: int
    not_run: int
    """Starts outside the tolerance."""
    medians: tuple[float, ...]
    """Medians by `MEASURES`; NaN where none was taken."""
    ninety: tuple[float, ...]
    """The ninth decile."""
    reset_s: float
    """Mean seconds of a reset."""


def robot_trials(rows: Sequence[TrialRow]) -> list[RobotTrial]:
    """The field `robot` of the rows that have one."""
    return [RobotTrial.of_json(row.robot) for row in rows if row.robot is not None]


def start_errors(rows: Sequence[TrialRow], measure: str) -> np.ndarray:
    """(N,) worst start error of each row, NaN where it was not measured."""
    found = []
    for row in rows:
        start = None if row.robot is None else RobotTrial.of_json(row.robot).start_error
        worst = None if start is None else start.worst(measure)
        found.append(np.nan if worst is None else worst)
    return np.array(found, float)


def summary(rows: Sequence[TrialRow]) -> StartSummary:
    """Starts of trials."""
    trials = robot_trials(rows)
    resets = [t.reset_s for t in trials if t.reset_s is not None]
    columns = [start_errors(rows, name) for name, _ in MEASURES]
    return StartSummary(
        len(trials),
        sum(row.outcome == "state_mismatch" for row in rows),
        tuple(_quantile(c, 0.5) for c in columns),
        tuple(_quantile(c, 0.9) for c in columns),
        float(np.mean(resets)) if resets else float("nan"),
    )


def _quantile(values: np.ndarray, share: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else float("nan")


def verdict_slope(rows: Sequence[TrialRow], measure: str, level: float = 0.95) -> VerdictSlope:
    """Change of the log-odds of success per unit of start error, of valid trials.

    Args:
        rows: of any policies.
        measure: see `MEASURES`.
        level: of the interval.
    """
    kept = [r for r in rows if r.outcome in ("success", "horizon")]
    errors = start_errors(kept, measure)
    known = np.isfinite(errors)
    policies = np.array([r.policy for r in kept])[known]
    success = np.array([r.success for r in kept], float)[known]
    error = errors[known]
    if not len(error):
        return VerdictSlope(UNDEFINED, 0, "it was not measured")
    mixed = sorted(name for name in set(policies) if 0 < success[policies == name].mean() < 1)
    if not mixed:
        return VerdictSlope(UNDEFINED, 0, "each policy's verdicts are all alike")
    kept_here = np.isin(policies, mixed)
    policies, success, error = policies[kept_here], success[kept_here], error[kept_here]
    if len(error) < _LEAST_TRIALS:
        return VerdictSlope(UNDEFINED, len(error), f"fewer than {_LEAST_TRIALS} trials")
    if error.std() < 1e-9:
        return VerdictSlope(UNDEFINED, len(error), "all starts were alike")
    design = np.stack([*(policies == name for name in mixed), error], 1).astype(float)
    found = logistic_slope(design, success, level)
    reason = "successes and failures do not overlap" if found is UNDEFINED else ""
    return VerdictSlope(found, len(error), reason)


def logistic_slope(design: np.ndarray, success: np.ndarray, level: float = 0.95) -> Estimate:
    """The last coefficient of a logistic regression, with its Wald interval.

    Args:
        design: (N, K) float64.
        success: (N,) 0 or 1.
        level: of the interval.

    Returns:
        `UNDEFINED` where the data separate or do not decide the coefficient.
    """
    weights = np.zeros(design.shape[1])
    for _ in range(_ITERATIONS):
        linear = design @ weights
        if np.abs(linear).max() > _SEPARATED:
            return UNDEFINED
        chance = 1 / (1 + np.exp(-linear))
        information = (design * (chance * (1 - chance))[:, None]).T @ design
        if np.linalg.cond(information) > 1e12:
            return UNDEFINED
        step = np.linalg.solve(information, design.T @ (success - chance))
        weights = weights + step
        if np.abs(step).max() < _STEP:
            spread = float(np.sqrt(np.linalg.inv(information)[-1, -1]) * norm.ppf((1 + level) / 2))
            return Estimate(float(weights[-1]), float(weights[-1]) - spread, float(weights[-1]) + spread)
    return UNDEFINED
