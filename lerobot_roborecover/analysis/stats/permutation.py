"""The paired sign-flip permutation test: were the two alike, each unit's difference had either sign as
likely.

Exact at any number of units: scenario rates are fractions of few trials, so the sums of flipped differences
lie on a grid, and their distribution is worked out unit by unit. Differences off any small grid, or of very
many trials, are flipped at random by `scipy.stats.permutation_test`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import special, stats

_GRID = 2520
"""Differences are sought as fractions of at most this denominator: all trial counts up to ten fit."""
_WORK = 1_000_000_000
"""Multiplications that an exact distribution may take (about a second)."""
_FLIPS = 9_999
"""Random flips where it would take more; p is then (b + 1) / (flips + 1)."""


def sign_flip_p(differences: np.ndarray) -> float:
    """Two-sided p-value of "the two are alike".

    Args:
        differences: (n,) one total a unit.

    Returns:
        The share of all sign flips whose sum is at least as far from zero as the observed one; 1 where
        nothing differs; NaN without a unit.
    """
    x = np.asarray(differences, float)
    if not len(x):
        return float("nan")
    x = x[np.abs(x) > 1e-9]
    if not len(x):
        return 1.0
    whole = _on_grid(x)
    if whole is None or np.abs(whole).sum() ** 2 > _WORK:
        return _random_flips(x)
    return _exact(whole)


def differing(differences: np.ndarray) -> int:
    """Units whose difference is not zero."""
    return int((np.abs(np.asarray(differences, float)) > 1e-9).sum())


def _on_grid(x: np.ndarray) -> np.ndarray | None:
    """The differences as whole numbers of their common fraction; None where none is small enough."""
    for denominator in range(1, _GRID + 1):
        scaled = x * denominator
        whole = np.rint(scaled)
        if np.abs(scaled - whole).max() < 1e-7:
            return whole.astype(np.int64)
    return None


def _exact(whole: np.ndarray) -> float:
    steps = np.abs(whole)
    steps = steps // np.gcd.reduce(steps)
    observed = abs(int(whole.sum()) // int(np.gcd.reduce(np.abs(whole))))
    values, counts = np.unique(steps, return_counts=True)
    return _share_as_far(tuple(values.tolist()), tuple(counts.tolist()), observed)


@lru_cache(2**15)  # of many pairs of policies most differ alike
def _share_as_far(steps: tuple[int, ...], counts: tuple[int, ...], observed: int) -> float:
    """The share of flips of `counts[k]` differences of size `steps[k]` whose sum is as far from zero."""
    total = sum(step * count for step, count in zip(steps, counts, strict=True))
    # The sum of flipped differences is twice the sum of those that stay positive, less the total.
    chance = np.ones(1)
    for step, count in zip(steps, counts, strict=True):
        own = np.zeros(step * count + 1)
        own[::step] = _coins(count)
        chance = np.convolve(chance, own)
    sums = np.abs(2 * np.arange(total + 1) - total)
    return float(min(1.0, chance[sums >= observed].sum()))


def _coins(count: int) -> np.ndarray:
    """(count + 1,) chances of that many heads, exact in floating point while powers of two are."""
    if count > 1000:
        return stats.binom.pmf(np.arange(count + 1), count, 0.5)
    return special.comb(count, np.arange(count + 1)) * 0.5**count


def _random_flips(x: np.ndarray) -> float:
    found = stats.permutation_test(
        (x,),
        lambda sample, axis=-1: np.abs(sample.sum(axis=axis)),
        permutation_type="samples",
        alternative="greater",
        n_resamples=_FLIPS,
        batch=max(1, 20_000_000 // len(x)),
        vectorized=True,
        rng=np.random.default_rng(0),
    )
    return float(found.pvalue)
