"""What a retry is worth: success within k attempts from a recovery point, and within a budget of steps.

RSR@k of a scenario with n trials, s of them successful, is 1 - C(n - s, k) / C(n, k): the share of all
choices of k trials that hold a success. It is unbiased for the chance that one of k attempts succeeds (the
estimator that Chen et al. 2021, "Evaluating Large Language Models Trained on Code", call pass@k). At k = 1 it
is the scenario's rate. Every scenario counts the same.

The budget of steps is spent one attempt after the other, each from the same recovery point, until one
succeeds. A scenario's number is the mean over all orders of its trials.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.logs.row import TrialRow

ATTEMPTS = (1, 2, 3, 4, 5)
"""Numbers of attempts that tables show, as far as there are trials."""


@dataclass(frozen=True)
class Attempts:
    """One policy's trials of N scenarios, by run: another training run's trial is no retry."""

    title: str
    rows: tuple[Mapping[int, tuple[TrialRow, ...]], ...]
    """Rows of every run, by scenario index."""
    trials: np.ndarray
    """(R, N) int: attempts of every run; those without a row are failures that took the whole horizon. 0
    where the policy was not run."""
    horizons: np.ndarray
    """(N,) int, steps."""

    @property
    def most(self) -> int:
        """Largest k that every scenario has trials for, in every run; 0 without any trial."""
        run = self.trials[:, (self.trials > 0).any(0)]
        return int(run.min()) if run.size else 0

    @property
    def deterministic(self) -> bool:
        """Whether all trials of a scenario came out alike, to the action where the log says it."""
        groups = [rows for by_scenario in self.rows for rows in by_scenario.values() if len(rows) > 1]
        return bool(groups) and all(
            len({(row.outcome, row.steps, row.actions_sha256) for row in rows}) == 1 for rows in groups
        )


def attempts_of(arm: Arm, panel: Panel, index: int, scheduled: int | None = None) -> Attempts:
    """Sorts an arm's trials by run and scenario.

    Args:
        arm: whose.
        panel: whose scenarios, in its order.
        index: of the arm in the panel.
        scheduled: trials that every scenario was to have in every run; see `make_panel`.
    """
    place = {s.id: n for n, s in enumerate(panel.scenarios) if panel.trials[index, n]}
    found: list[dict[int, tuple[TrialRow, ...]]] = []
    for _, rows in arm.runs or ((arm.title, arm.rows),):
        by_scenario: dict[int, list[TrialRow]] = {}
        for row in rows:
            if row.scenario_id in place:
                by_scenario.setdefault(place[row.scenario_id], []).append(row)
        found.append({n: tuple(own) for n, own in by_scenario.items()})
    trials = np.zeros((len(found), len(panel.scenarios)), int)
    for r, of in enumerate(found):
        for n in place.values():
            trials[r, n] = len(of.get(n, ())) if scheduled is None else scheduled
    horizons = np.array([s.horizon for s in panel.scenarios], int)
    return Attempts(panel.arms[index], tuple(found), trials, horizons)


def share_within(successes: np.ndarray, trials: np.ndarray, attempts: int) -> np.ndarray:
    """Returns RSR@k of each entry: float64 in [0, 1], NaN with fewer than k trials.

    Args:
        successes: int, any shape.
        trials: int, the same shape.
        attempts: k, from 1.
    """
    lost = np.ones(np.shape(trials))
    failures = np.asarray(trials) - successes
    for j in range(attempts):
        lost = lost * np.maximum(failures - j, 0) / np.maximum(trials - j, 1)
    return np.where(np.asarray(trials) >= attempts, 1 - lost, np.nan)


def rates_within(policy: Attempts, attempts: Sequence[int]) -> np.ndarray:
    """(N, K) scenario rates of RSR@k, runs weighed by their trials; NaN above `most` and where not run."""
    successes = np.zeros(policy.trials.shape, int)
    for r, of in enumerate(policy.rows):
        for n, rows in of.items():
            successes[r, n] = sum(row.success for row in rows)
    columns = []
    for k in attempts:
        shares = share_within(successes, policy.trials, k)
        columns.append(_over_runs(policy, np.where(k <= policy.most, shares, np.nan)[..., None])[:, 0])
    return np.stack(columns, 1)


def rates_for_steps(policy: Attempts, budgets: np.ndarray) -> np.ndarray:
    """Scenario rates when attempts follow one another until a budget of steps is spent.

    Args:
        policy: its trials.
        budgets: (B,) in horizons of the scenario. Up to `most` no order runs out of attempts, but where
            trials ended before their horizon without success.

    Returns:
        (N, B) in [0, 1]; NaN above `most` and where not run.
    """
    budgets = np.asarray(budgets, float)
    shares = np.full((*policy.trials.shape, len(budgets)), np.nan)
    for r, n in zip(*np.nonzero(policy.trials), strict=True):
        rows, count = policy.rows[r].get(n, ()), int(policy.trials[r, n])
        horizon = int(policy.horizons[n])
        solved = [row.steps for row in rows if row.success]
        failed = [row.steps for row in rows if not row.success] + [horizon] * (count - len(rows))
        steps, weight = _first_success(solved, failed)
        # 1.5 * 45 steps allows 67 whole steps; rounding noise in the product must not cost one.
        limits = np.floor(budgets * horizon + 1e-9)
        reached = np.searchsorted(steps, limits, side="right")
        shares[r, n] = np.concatenate([[0.0], np.cumsum(weight)])[reached]
    shares[..., budgets > policy.most] = np.nan
    return _over_runs(policy, shares)


def _first_success(solved: Sequence[int], failed: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Steps until the first success, sorted, and the share of all orders of the trials for each."""
    count = len(solved) + len(failed)
    # How many sets of j failed trials have these steps together.
    sets: Counter[tuple[int, int]] = Counter({(0, 0): 1})
    for steps in failed:
        for (j, total), number in list(sets.items()):
            sets[j + 1, total + steps] += number
    weights: Counter[int] = Counter()
    for (j, total), number in sets.items():
        orders = factorial(j) * factorial(count - j - 1) if j < count else 0
        for steps in solved:
            weights[total + steps] += number * orders
    found = sorted(weights)
    return np.array(found, float), np.array([weights[steps] / factorial(count) for steps in found])


def _over_runs(policy: Attempts, shares: np.ndarray) -> np.ndarray:
    """(N, ...) means of (R, N, ...) over runs, each with the weight of its trials."""
    weight = policy.trials[..., None].astype(float)
    total = weight.sum(0)
    summed = (np.where(weight > 0, shares, 0.0) * weight).sum(0)
    return np.divide(summed, total, out=np.full(summed.shape, np.nan), where=total > 0)
