"""One sampling for all numbers of a report: what is independent, the intervals over it, and the bootstrap's
draws.

The intervals that are printed are those of `intervals.py`. The bootstrap gives the paper's own columns and
the spread of what has no formula (orders of policies); one set of draws serves all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import DRAWS, draw_counts
from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    RARE,
    Bounds,
    Estimate,
    WeightedMean,
    clean,
    difference_interval,
    estimates_of,
    rate_interval,
    ratio_interval,
    spread,
)

_DRAWS_AT_ONCE = 1000
SEED = 0
"""Seed of the draws unless another is asked for; the same as the demo's table uses."""


@dataclass(frozen=True)
class Resampling:
    """N scenarios in their units (`units.ResamplingUnit`), at one level of confidence."""

    index: np.ndarray
    """(N,) int: every scenario's unit."""
    units: int
    draws: int
    seed: int
    level: float = LEVEL

    @cached_property
    def weights(self) -> np.ndarray:
        """(draws, N) float64: how often each scenario occurs in each draw of the bootstrap."""
        if not self.units:
            return np.zeros((self.draws, 0))
        return _counts(self.units, self.draws, self.seed)[:, self.index].astype(float)

    def part(self, scenarios: np.ndarray) -> Resampling:
        """Of some of the scenarios, by index, with the same draws, seed and level."""
        return resample(self.index[scenarios], self.draws, self.seed, self.level)

    def rates(
        self, values: np.ndarray, *, cells: np.ndarray | None = None, weights: np.ndarray | None = None
    ) -> list[Estimate]:
        """Mean of each of (N, K) columns of numbers from 0 to 1, with its interval.

        Args:
            values: NaN where a scenario has none.
            cells: (N,) labels: the mean is that of the cells' means (Macro).
            weights: (N, K) of the scenarios, by default all the same: a column is then a ratio of sums.
        """
        return self._columns(rate_interval, values, cells, weights)

    def rates_of_retries(self, values: np.ndarray) -> list[Estimate]:
        """Mean of each of (N, K) columns of shares within several attempts, with its interval."""
        return self._columns(partial(rate_interval, rare=RARE), values)

    def differences(self, values: np.ndarray) -> list[Estimate]:
        """Mean of each of (N, K) columns of paired differences of rates, with its interval."""
        return self._columns(difference_interval, values)

    def ratios(self, top: np.ndarray, bottom: np.ndarray) -> list[Estimate]:
        """Ratio of the means of each of (N, K) columns on the scenarios that have both, with Fieller's
        interval.

        NaN where the lower mean is zero.
        """
        both = np.isfinite(top) & np.isfinite(bottom)
        upper, lower = (np.where(both, rates, 0.0).sum(0) for rates in (top, bottom))
        values = np.divide(upper, lower, out=np.full(len(lower), np.nan), where=lower > 0)
        return estimates_of(values, ratio_interval(top.T, bottom.T, self.index, self.level))

    def spread(self, values: np.ndarray, cells: np.ndarray | None = None) -> WeightedMean:
        """Of (..., N) values: one column of scenarios, or several."""
        return spread(values, self.index, cells=cells)

    def _columns(
        self,
        interval: Callable[[WeightedMean, float], Bounds],
        values: np.ndarray,
        cells: np.ndarray | None = None,
        weights: np.ndarray | None = None,
    ) -> list[Estimate]:
        own = None if weights is None else weights.T
        columns = spread(values.T, self.index, cells=cells, weights=own)
        return estimates_of(columns.value, interval(columns, self.level))

    def means(self, values: np.ndarray) -> np.ndarray:
        """Means of every draw over the scenarios that have a value.

        Args:
            values: (N, K); NaN where a scenario has none.

        Returns:
            (draws, K); NaN for a draw without any such scenario.
        """
        known = np.isfinite(values)
        if not self.units:
            return np.full((self.draws, values.shape[1]), np.nan)
        # Sums by unit first: a draw takes whole units, and its counts are small numbers in few bytes.
        sums, sizes = np.zeros((2, self.units, values.shape[1]))
        np.add.at(sums, self.index, np.where(known, values, 0.0))
        np.add.at(sizes, self.index, known)
        found = np.full((self.draws, values.shape[1]), np.nan)
        counts = _counts(self.units, self.draws, self.seed)
        for first in range(0, self.draws, _DRAWS_AT_ONCE):
            part = counts[first : first + _DRAWS_AT_ONCE].astype(float)
            mass = part @ sizes
            np.divide(part @ sums, mass, out=found[first : first + len(part)], where=mass > 0)
        return found

    def interval(self, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Percentile bounds of (draws, K) values; NaN with fewer than two units, or no value at all."""
        width = draws.shape[1]
        if self.units < 2 or not len(draws):
            return np.full(width, np.nan), np.full(width, np.nan)
        levels = [(1 - self.level) / 2, (1 + self.level) / 2]
        holes = np.isnan(draws).any(0)
        bounds = np.full((2, width), np.nan)
        if not holes.all():
            bounds[:, ~holes] = np.quantile(draws[:, ~holes], levels, axis=0)
        for k in np.flatnonzero(holes):
            column = draws[:, k][~np.isnan(draws[:, k])]
            if len(column):
                bounds[:, k] = np.quantile(column, levels)
        return bounds[0], bounds[1]

    def percentile(self, values: np.ndarray) -> list[Estimate]:
        """The paper's estimates: mean and percentile bootstrap of each of (N, K) columns.

        No interval for fewer than two scenarios. For the columns that are compared with the paper; intervals
        that cover are `rates` and `differences`.
        """
        count = np.isfinite(values).sum(0)
        low, high = self.interval(self.means(values))
        points = masked_mean(values)
        return [
            Estimate(float(p), float(clean(a)), float(clean(b)))
            if n > 1
            else Estimate(float(p), np.nan, np.nan)
            for p, a, b, n in zip(points, low, high, count, strict=True)
        ]


def resample(
    units: Sequence[str] | np.ndarray, draws: int = DRAWS, seed: int = SEED, level: float = LEVEL
) -> Resampling:
    """Sorts scenarios into their units.

    Args:
        units: N labels; scenarios that share one are drawn together.
        draws: bootstrap draws (paper: 10,000).
        seed: of the draws.
        level: confidence level.
    """
    index = np.unique(np.asarray(units), return_inverse=True)[1]
    return Resampling(index, int(index.max()) + 1 if len(index) else 0, draws, seed, level)


@lru_cache(maxsize=32)
def _counts(units: int, draws: int, seed: int) -> np.ndarray:
    """(draws, units) how often each unit is drawn; tables and figures ask for the same ones again."""
    rng = np.random.default_rng(seed)
    counts = np.empty((draws, units), np.uint16 if units < 2**16 else np.int64)
    for first in range(0, draws, _DRAWS_AT_ONCE):  # the same draws as all at once, in a tenth of the memory
        part = counts[first : first + _DRAWS_AT_ONCE]
        part[:] = draw_counts(rng, units, len(part))
    counts.setflags(write=False)
    return counts


def masked_mean(values: np.ndarray) -> np.ndarray:
    """(K,) means of (N, K) columns over their finite entries; NaN for a column without one."""
    known = np.isfinite(values)
    count = known.sum(0)
    total = np.where(known, values, 0.0).sum(0)
    return np.divide(total, count, out=np.full(values.shape[1], np.nan), where=count > 0)
