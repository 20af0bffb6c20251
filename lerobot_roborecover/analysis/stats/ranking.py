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

from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.resampling import Resampling, masked_mean


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


@dataclass(frozen=True)
class StartRates:
    """Rates of P policies from one start, and what is independent in them."""

    policies: tuple[str, ...]
    rates: np.ndarray
    """(P, N) in [0, 1]; columns are first states where the trials are initial-state ones, else scenarios."""
    resampling: Resampling
    """Resampling of the N columns."""

    @property
    def means(self) -> np.ndarray:
        """(P,) each column weighing the same."""
        return masked_mean(self.rates.T)


@dataclass(frozen=True)
class PairFromBothStarts:
    """Two policies from initial states and from recovery points."""

    initial: Contrast
    recovery: Contrast
    error: float
    """Holm-adjusted p below which a difference is shown: two families of verdicts must hold at once, and each
    gets half of the error. That is valid however trials of the two starts depend on each other."""

    @property
    def inverted(self) -> bool:
        """Whether the observed order is the other way round at recovery."""
        return self.initial.difference.value * self.recovery.difference.value < 0

    @property
    def shown(self) -> int:
        """1 where the same order is shown from both starts, -1 where the opposite order is, else 0."""
        return _direction(self.initial, self.error) * _direction(self.recovery, self.error)


def _direction(contrast: Contrast, error: float) -> int:
    known = contrast.p_holm == contrast.p_holm
    return int(np.sign(contrast.difference.value)) if known and contrast.p_holm < error else 0


def pairs_from_both_starts(initial: StartRates, recovery: StartRates) -> list[PairFromBothStarts]:
    """Returns every pair of the policies, tested from both starts.

    Args:
        initial: by first state.
        recovery: of the same policies, by scenario.
    """
    error = (1 - recovery.resampling.level) / 2
    families = (contrasts(s.rates, s.policies, s.resampling) for s in (initial, recovery))
    return [PairFromBothStarts(a, b, error) for a, b in zip(*families, strict=True)]


def rank_agreement(initial: StartRates, recovery: StartRates) -> RankAgreement:
    """Compares the order by initial-state rate with the order by RSR.

    Args:
        initial: by first state.
        recovery: of the same policies, by scenario.
    """
    names = initial.policies
    first, second = initial.means, recovery.means
    pairs = inverted_pairs(first, second)
    total = len(names) * (len(names) - 1) // 2
    products = np.array([pair.shown for pair in pairs_from_both_starts(initial, recovery)], int)
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
