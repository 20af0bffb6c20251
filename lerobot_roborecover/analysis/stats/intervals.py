"""Intervals that cover: of rates, of paired differences and of ratios, over units of any size.

Chosen by simulation (`benchmarks/coverage.py`; table: docs/statistics.md). A percentile bootstrap of few
scenarios, or of a rate near 0 or 1, knows only the values that it drew, and misses far more often than it
says.

- A rate has the Agresti-Coull interval (Agresti and Coull 1998) with the effective number of units in place
  of the number of trials: p (1 - p) over the variance of the rate, and Student's t for the normal quantile
  (as Korn and Graubard 1998 do for the exact interval). The variance is that between units, with the variance
  of one all-or-nothing unit mixed in, because a few equal units say little about how far others scatter.
- Where no unit has a success, or none a failure, nothing scatters, and the rate has the exact interval of
  Clopper and Pearson (1934) over the units. It holds whatever the rates of the scenarios and however many
  trials each has: at one mean rate, units that are alike fail all together most often. Units of unlike weight
  have its equivalent (`_all_alike`): the largest mean rate at which all fail with the chance left for it.
- Success within k attempts (RSR@k) is near 1 for most scenarios and 0 for a few that hardly ever occur: the
  scenarios at hand then scatter less than others like them. As many all-or-nothing units are mixed in as it
  takes for `RARE` of them to fail.
- A paired difference has Student's t with one unit more, half of it won by each side: what Bonett and Price
  (2012) do for pairs of yes and no.
- A number that is no mean, such as F1 or the area under a curve, has the interval of a rate, its variance
  from the jackknife.
- A ratio has Fieller's set from the paired difference; a number of steps, the paired difference's on the
  scale of the horizon.

All take scenarios as weighing the same, or cells where these are given. Units that hold several scenarios, or
weigh differently, enter with their totals; degrees of freedom follow Satterthwaite's rule. Every function
takes one column of scenarios or many at once: the last axis is the scenarios'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import special

LEVEL = 0.95
"""Confidence level unless another is asked for."""
RARE = 3.0
"""Of RSR@k: with as many units as it takes for three to fail, a failure is likely to be among them."""
_TINY = 1e-12
"""Rounding of sums of rates; a variance or bound below it is none."""
_LEAST_FREEDOM = 0.2


@dataclass(frozen=True)
class Estimate:
    """A number with its interval, a rate or difference of rates in units of one; NaN where nothing can be
    said."""

    value: float
    low: float
    high: float


UNDEFINED = Estimate(float("nan"), float("nan"), float("nan"))
"""Where nothing can be said."""


def independent_difference(a: Estimate, b: Estimate) -> Estimate:
    """The number a less b, of different trials on different scenarios.

    Its interval is put together from the two intervals (MOVER: Newcombe 1998, method 10; Donner, Zou 2012),
    whatever these were made by.
    """
    value = a.value - b.value
    return Estimate(
        value,
        value - math.hypot(a.value - a.low, b.high - b.value),
        value + math.hypot(a.high - a.value, b.value - b.low),
    )


@dataclass(frozen=True)
class WeightedMean:
    """Weighted means and how well their units pin them down: numbers of one column, arrays of several."""

    value: float | np.ndarray
    variance: float | np.ndarray
    """Variance of the mean, between units; NaN for fewer than two."""
    units: float | np.ndarray
    effective: float | np.ndarray
    """Units of one weight that would weigh as these do: 1 over the sum of their squared weights."""
    freedom: float | np.ndarray
    """Degrees of freedom of the variance."""
    weights: np.ndarray | None = field(default=None, compare=False, repr=False)
    """(..., U) shares of the units in the mean; None where the effective number stands for them."""


def spread(
    values: np.ndarray,
    units: Sequence[str] | np.ndarray | None = None,
    *,
    cells: Sequence[str] | np.ndarray | None = None,
    weights: np.ndarray | None = None,
) -> WeightedMean:
    """The means of scenarios' values, and their variances over units.

    Args:
        values: (..., N) one number a scenario; NaN where it has none.
        units: N labels of what is independent; None takes every scenario for itself.
        cells: N labels, of rates only: the mean is that of the cells' means, and scenarios scatter within
            their cells. A cell with a single scenario scatters around the mean of all.
        weights: (..., N) from zero up, by default all the same; not together with cells.
    """
    y = np.ascontiguousarray(values, float)  # sums then round the same for one column and for many
    known = np.isfinite(y)
    y = np.where(known, y, 0.0)
    n = known.sum(-1, keepdims=True)
    lacking = 0.0
    if cells is None:
        w = known.astype(float) if weights is None else np.where(known, weights, 0.0)
        w = _over(w, w.sum(-1, keepdims=True))
        value = _over(y.sum(-1, keepdims=True), n) if weights is None else (w * y).sum(-1, keepdims=True)
        residual, freedom = y - value, np.inf
    else:
        cell = _index(cells)
        group = _Groups(cell)
        size = group.sums(known)  # (..., C)
        here = size > 0
        occupied = here.sum(-1, keepdims=True)
        means = _over(group.sums(y), size)
        value = _over(means.sum(-1, keepdims=True), occupied)
        w = np.where(known, _over(1.0, (occupied * size)[..., cell]), 0.0)
        around = y - means[..., cell]
        alone = (size == 1)[..., cell]
        more = np.maximum(size - 1, 1)
        residual = np.where(alone, y - value, around * np.sqrt(size / more)[..., cell])
        share = _over(1.0, size)
        freedom = _over(share.sum(-1, keepdims=True) ** 2, (share**2 / more).sum(-1, keepdims=True))
        # A small cell without a failure looks certain: each cell has one all-or-nothing scenario mixed in.
        own = group.sums(np.where(known, around, 0.0) ** 2) / more
        short = np.where(size > 1, value * (1 - value) - own, 0.0) * share**2
        lacking = np.maximum(_over(short.sum(-1, keepdims=True), occupied**2), 0.0)
    total, weight = w * residual, w
    if units is not None:
        group = _Groups(_index(units))
        total, weight = group.sums(total), group.sums(weight)
    count = (weight > 0).sum(-1, keepdims=True)
    squares = (weight**2).sum(-1, keepdims=True)
    own = _over(squares**2, (weight**4).sum(-1, keepdims=True)) - 1
    bessel = _over(count, count - 1)
    if cells is not None:
        # Within cells the residuals are corrected already; whole units ask for it where they span scenarios.
        bessel = np.where(count == n, 1.0, bessel)
    variance = np.where(count > 1, bessel * (total**2).sum(-1, keepdims=True) + lacking, np.nan)
    return WeightedMean(
        _plain(np.where(count > 0, value, np.nan)),
        _plain(variance),
        _plain(count),
        _plain(_over(1.0, squares)),
        _plain(np.where(count > 1, np.maximum(np.minimum(own, freedom), _LEAST_FREEDOM), 0.0)),
        weight,
    )


def jackknife(value: np.ndarray | float, left_out: np.ndarray, weights: np.ndarray) -> WeightedMean:
    """How well units pin down a number that is no mean: it is worked out again with each unit left out (Tukey
    1958).

    Args:
        value: (...) on all units.
        left_out: (..., U) with each of them left out in turn.
        weights: (..., U) how much each of them says; those of weight zero say nothing, and are none.
    """
    w = np.broadcast_to(np.asarray(weights, float), np.shape(left_out))
    here = w > 0
    count = here.sum(-1, keepdims=True)
    others = np.where(here, left_out, 0.0)
    around = np.where(here, others - _over(others.sum(-1, keepdims=True), count), 0.0)
    variance = _over(count - 1, count) * (around**2).sum(-1, keepdims=True)
    w = _over(w, w.sum(-1, keepdims=True))
    squares = (w**2).sum(-1, keepdims=True)
    freedom = _over(squares**2, (w**4).sum(-1, keepdims=True)) - 1
    return WeightedMean(
        _plain(np.asarray(value, float)[..., None]),
        _plain(np.where(count > 1, variance, np.nan)),
        _plain(count),
        _plain(_over(1.0, squares)),
        _plain(np.where(count > 1, np.maximum(freedom, _LEAST_FREEDOM), 0.0)),
        w,
    )


class _Groups:
    """Sums over the groups of the last axis, in one order whatever else is summed beside them."""

    def __init__(self, index: np.ndarray):
        self.order = np.argsort(index, kind="stable")
        self.first = np.flatnonzero(np.diff(index[self.order], prepend=-1))

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(..., groups) of (..., N)."""
        if not len(self.first):
            return np.zeros((*values.shape[:-1], 0))
        return np.add.reduceat(values[..., self.order].astype(float), self.first, axis=-1)


def _index(labels: Sequence[str] | np.ndarray) -> np.ndarray:
    return np.unique(np.asarray(labels), return_inverse=True)[1]


def _over(top: np.ndarray | float, bottom: np.ndarray) -> np.ndarray:
    """The ratio; zero where the lower number is none."""
    shape = np.broadcast_shapes(np.shape(top), np.shape(bottom))
    return np.divide(top, bottom, out=np.zeros(shape), where=np.asarray(bottom) > 0)


def _plain(column: np.ndarray) -> float | np.ndarray:
    """Without the last axis; a number where that was the only one."""
    return column[..., 0] if column.ndim > 1 else column[0].item()


Bounds = tuple[float, float] | tuple[np.ndarray, np.ndarray]
"""Low and high: numbers of one column, arrays of several."""


def estimate_of(value: float | np.ndarray, bounds: Bounds) -> Estimate:
    """One column's number with its bounds."""
    low, high = bounds
    return Estimate(float(value), float(low), float(high))


def estimates_of(values: float | np.ndarray, bounds: Bounds) -> list[Estimate]:
    """Several columns' numbers, each with its bounds."""
    columns = (np.asarray(part).tolist() for part in (values, *bounds))
    return [Estimate(*parts) for parts in zip(*columns, strict=True)]


def rate_interval(found: WeightedMean, level: float = LEVEL, rare: float = 0.0) -> Bounds:
    """Interval of a mean of numbers from 0 to 1: Agresti-Coull with the effective number of units, or
    Clopper-Pearson where all units are 0 or all are 1.

    Args:
        found: the mean and its variance.
        level: confidence level.
        rare: all-or-nothing units that are mixed into the variance: so many that this number of them would
            fail (or succeed, where that is rarer); at least one unit.

    Returns:
        Bounds in [0, 1]; NaN for fewer than two units, which say nothing about how they scatter.
    """
    value, variance, _, units, freedom = _arrays(found)
    q = _quantile(level, freedom)
    p = np.clip(value, 0.0, 1.0)
    own = p * (1 - p)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.maximum(1.0, rare / np.maximum(np.minimum(p, 1 - p), _TINY))
        mixed = (freedom * variance + whole * own / units) / (freedom + whole)
        scatter = (variance > _TINY**2) & (mixed > 0)
        effective = np.where(scatter, own / mixed, units)
        count = effective + q * q
        centre = (p * effective + q * q / 2) / count
        half = q * np.sqrt(np.maximum(centre * (1 - centre), 0.0) / count)
    reach = _all_alike(found, (1 - level) / 2)
    none, every = value <= _TINY, value >= 1 - _TINY
    low = np.where(every, 1 - reach, np.where(none, 0.0, np.maximum(centre - half, 0.0)))
    high = np.where(none, reach, np.where(every, 1.0, np.minimum(centre + half, 1.0)))
    return _bounds(found, low, high)


def _all_alike(found: WeightedMean, chance: float) -> np.ndarray:
    """(...) the largest mean rate at which all units fail together with the given chance, whatever the rates
    of the units: 1 - chance ** (1 / n) of n units that weigh the same, which is Clopper and Pearson's bound.

    The product of the units' chances to fail is largest, at one mean rate, where the m heaviest units fail
    with chances that are inversely proportional to their weights, and the others surely.
    """
    if found.weights is None:
        return 1 - chance ** (1 / np.maximum(np.asarray(found.effective, float), 1.0))
    w = -np.sort(-found.weights, axis=-1)
    number = np.arange(1, w.shape[-1] + 1)
    logs = np.log(np.where(w > 0, w, 1.0)).cumsum(-1)
    common = np.exp((np.log(chance) + logs) / number)
    allowed = (w > 0) & (common <= w)
    return np.where(allowed, w.cumsum(-1) - number * common, 0.0).max(-1, initial=0.0)


def difference_interval(found: WeightedMean, level: float = LEVEL) -> Bounds:
    """Interval of a mean of paired differences of rates, numbers from -1 to 1.

    Returns:
        Bounds in [-1, 1]; NaN for fewer than two units.
    """
    centre, error, freedom = _one_unit_more(found)
    half = _quantile(level, freedom) * error
    return _bounds(found, np.maximum(centre - half, -1.0), np.minimum(centre + half, 1.0))


def difference_p(found: WeightedMean) -> float:
    """Two-sided p-value of that interval, of one column: 1 less the level at which it begins to hold zero;
    NaN for fewer than two units."""
    centre, error, freedom = (float(x) for x in _one_unit_more(found))
    if found.units < 2 or not error > 0:
        return float("nan")
    return float(2 * special.stdtr(freedom, -abs(centre) / error))


def _one_unit_more(found: WeightedMean) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences with one unit more, half of it won by each side; their standard errors, and degrees of
    freedom."""
    d, variance, count, n, freedom = _arrays(found)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = n * variance * (count - 1) / count + d * d
        centre = n * d / (n + 1)
        scatter = np.maximum((n * square + 1) / (n + 1) - centre**2, 0.0)
        return centre, np.sqrt(scatter / (n + 1)), freedom


def ratio_interval(
    top: np.ndarray,
    bottom: np.ndarray,
    units: Sequence[str] | np.ndarray | None = None,
    level: float = LEVEL,
) -> Bounds:
    """Interval of a ratio of two mean rates on the same scenarios: ratios that the paired difference allows.

    Args:
        top: (..., N) rates in [0, 1]; NaN where there is none.
        bottom: (..., N) rates.
        units: N labels; None takes every scenario for itself.
        level: confidence level.

    Returns:
        Bounds from zero up; NaN where no upper bound is to be had (the lower rate may be zero), or for fewer
        than two units.
    """
    top, bottom = np.asarray(top, float), np.asarray(bottom, float)
    both = np.isfinite(top) & np.isfinite(bottom)
    x, y = np.where(both, top, np.nan), np.where(both, bottom, np.nan)
    first = spread(x, units)
    a, above, count, n, freedom = _arrays(first)
    b, below, *_ = _arrays(spread(y, units))
    both_ways = spread(x + y, units).variance
    s = _quantile(level, freedom) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        shrink = n * (count - 1) / count
        aa, bb = shrink * above + a * a, shrink * below + b * b
        ab = shrink * (both_ways - above - below) / 2 + a * b
        # With r the ratio and one more unit, half of it won by each side: the mean of x - r y is within q
        # standard errors of zero where k(r) = [n (a - r b)]^2 (1 + q^2 / (n + 1)) - q^2 [n E(x - r y)^2 +
        # (1 + r^2) / 2] <= 0.
        scale = 1 + s / (n + 1)
        quadratic = n * n * b * b * scale - s * (n * bb + 0.5)
        linear = -2 * (n * n * a * b * scale - s * n * ab)
        constant = n * n * a * a * scale - s * (n * aa + 0.5)
        root = np.sqrt(linear**2 - 4 * quadratic * constant)
        low, high = ((-linear + sign * root) / (2 * quadratic) for sign in (-1, 1))
    bounded = (quadratic > 0) & np.isfinite(root) & (b > 0)
    return _bounds(first, np.where(bounded, np.maximum(low, 0.0), np.nan), np.where(bounded, high, np.nan))


def _arrays(found: WeightedMean) -> tuple[np.ndarray, ...]:
    of = (found.value, found.variance, found.units, found.effective, found.freedom)
    return tuple(np.asarray(values, float) for values in of)


def _quantile(level: float, freedom: float | np.ndarray) -> np.ndarray:
    return special.stdtrit(freedom, 0.5 + level / 2)


def _bounds(found: WeightedMean, low: np.ndarray, high: np.ndarray) -> Bounds:
    """NaN where there are fewer than two units."""
    enough = np.asarray(found.units) > 1
    low, high = (clean(np.where(enough, bound, np.nan)) for bound in (low, high))
    return (low, high) if low.ndim else (low.item(), high.item())


def clean(bound: float | np.ndarray) -> np.ndarray:
    """Bounds that only rounding tells from zero or one are zero or one, and decide nothing."""
    whole = np.rint(bound)
    return np.where((np.abs(bound - whole) < _TINY) & (np.abs(whole) <= 1), whole + 0.0, bound)
