"""Does the order of policies from initial states hold at recovery points? Inversions, rho, tau.

What can be said for certain comes from the same evidence as every other verdict: pairs that are separated
from both starts. A bootstrap of ranks is not used: it adds noise of its own to an order that is noisy
already, and its intervals miss (`benchmarks/coverage.py --ranks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from lerobot_roborecover.analysis.contrasts import contrasts
from lerobot_roborecover.analysis.intervals import Estimate
from lerobot_roborecover.analysis.resampling import Resampling, masked_mean


@dataclass(frozen=True)
class RankAgreement:
    """How two orders of the same policies agree."""

    policies: int
    inversions: Estimate
    """Pairs that the two orders put the other way round, a tie in either being none. Low: pairs shown to be
    so from both starts; high: all pairs but those shown to be the same way round from both."""
    inverted: tuple[tuple[str, str], ...]
    """Those pairs: first the one that is higher initially."""
    shown_same: int
    """Pairs that are separated the same way from both starts."""
    shown_inverted: int
    """Pairs that are separated the other way round."""
    rho: float
    """Spearman's; NaN with fewer than two policies or when one order has only ties."""
    tau: Estimate
    """Kendall's tau-b, with bounds from the same pairs."""


def inverted_pairs(
    initial: Sequence[float] | np.ndarray, recovery: Sequence[float] | np.ndarray
) -> list[tuple[int, int]]:
    """Index pairs that swap order, the initially higher one first."""
    found = []
    for a, b in combinations(range(len(initial)), 2):
        if (initial[a] - initial[b]) * (recovery[a] - recovery[b]) < 0:
            found.append((a, b) if initial[a] > initial[b] else (b, a))
    return found


def rank_agreement(
    initial: np.ndarray, recovery: np.ndarray, names: Sequence[str], resampling: Resampling
) -> RankAgreement:
    """Compares the order by initial-state rate with the order by RSR.

    Args:
        initial: (P, N) rates; NaN where not run.
        recovery: (P, N) rates of the same policies on the same scenarios.
        names: P names.
        resampling: of the N scenarios.
    """
    first, second = masked_mean(initial.T), masked_mean(recovery.T)
    pairs = inverted_pairs(first, second)
    total = len(names) * (len(names) - 1) // 2
    # Two families of verdicts must all hold at once: each gets half of the error.
    error = (1 - resampling.level) / 2
    shown = [
        0 if c.p_holm != c.p_holm or c.p_holm >= error else int(np.sign(c.difference.value))
        for rates in (initial, recovery)
        for c in contrasts(rates, names, resampling)
    ]
    products = np.array(shown[:total]) * np.array(shown[total:])
    same, other = int((products > 0).sum()), int((products < 0).sum())
    low, high = (2 * same / total - 1, 1 - 2 * other / total) if total else (float("nan"), float("nan"))
    rho, tau = _coefficients(first, second)
    return RankAgreement(
        policies=len(names),
        inversions=Estimate(float(len(pairs)), float(other), float(total - same)),
        inverted=tuple((names[a], names[b]) for a, b in pairs),
        shown_same=same,
        shown_inverted=other,
        rho=rho,
        tau=Estimate(tau, low, high),
    )


def _coefficients(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Spearman's and Kendall's; NaN where one of the orders is none."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return float("nan"), float("nan")
    return float(stats.spearmanr(x, y).statistic), float(stats.kendalltau(x, y).statistic)
