"""Evidence that may be looked at after every scenario: a test that stops as soon as it is decided, and a
confidence sequence of a rate.

- **The test** is the sign-flip test of `permutation.py`, taken step by step. Were the two policies alike,
  each unit's difference had either sign as likely, so the sum of the differences so far is a random walk
  whose law is known, given the sizes of its steps. Of the error, a share `(t / n) ** SPENDING` may be spent
  by unit t of n (an alpha-spending function, Lan and DeMets 1983); the boundary at t is the nearest one whose
  chance of being crossed for the first time, by a walk that has crossed none before, is within what is left.
  It is exact, needs the number of units beforehand (as STEP does, Snyder et al. 2025, arXiv 2503.10966), and
  keeps nearly all the power of one look at the end; a betting e-process, which needs no such number, loses up
  to half of it (docs/log/statistics.md has both).
- **Rates and differences** have confidence sequences by betting (Waudby-Smith and Ramdas 2024): against
  every candidate mean a gambler bets, with several stakes at once; where he has made twenty times the stake,
  the candidate is left out (Ville's inequality). They hold at any time, for any law of the scenarios, and are
  wider than the test is sharp: it may have decided while the interval of the difference still holds zero.
  (The repeated interval of the test's own boundary would go with it, and misses: a boundary for alike
  policies says nothing of the scatter of different ones; at rates of .02 and .1 it held the difference half
  of the time.)

All three take the units in an order fixed beforehand and unrelated to results: `sequence` is one,
pseudo-random by the units' names. Neither the order of a set (its tasks stand together) nor the order in
which trials end (successes end early) will do.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import LEVEL, UNDEFINED, Estimate

SPENDING = 2.0
"""By the time that a share t of the units is in, a share t ** SPENDING of the error has been spent: little
early, when only a large difference could be told."""
GRID = 120
"""Finest fraction that differences are rounded to; that leaves the walk's signs alone, and the test exact."""
_SALT = "roborecover sequence"
_STAKES = np.array([0.9, 0.7, 0.5, 0.35, 0.25, 0.15, 0.08, 0.04, 0.02])
"""Shares of its capital that the gambler bets, each for a ninth of it."""
_CANDIDATES = np.linspace(0, 1, 501)[1:-1]


def sequence(units: Iterable[str]) -> list[str]:
    """Units, each once, in the order in which they are run and counted: by a hash of their names.

    It is the same on every machine, and that of a part of them is the part of the order.
    """
    return sorted(set(units), key=lambda name: hashlib.sha256(f"{_SALT}/{name}".encode()).digest())


def grid_of(trials: Iterable[int]) -> int:
    """Fraction that differences of rates over so many trials are whole numbers of, or `GRID`."""
    whole = math.lcm(*{t for t in trials if t > 0})
    return whole if whole <= GRID else GRID


class SequentialTest:
    """The sign-flip test of paired differences, unit by unit.

    Args:
        units: how many there will be, known beforehand.
        grid: see `grid_of`.
        level: confidence level, that of the whole test.
    """

    def __init__(self, units: int, grid: int = GRID, level: float = LEVEL):
        self.planned, self.level, self._grid = units, level, grid
        self.steps: list[int] = []
        """Totals of the units so far, in fractions of the grid."""
        self.scenarios = 0
        self.decided_after: int | None = None
        """Units at which the boundary was crossed."""
        self.p = 1.0
        """Two-sided p-value by the order of stages: the chance of a decision before, or of so large a sum
        now. One until the decision or the last unit, because it may be looked at at any time."""
        self._mean = RateSequence(level)
        self._waiting: list[float] = []
        """Values that the interval takes in when it is asked for."""
        self._walk = _Walk(units, 1 - level)

    def add(self, total: float, scenarios: int = 1) -> None:
        """Takes the next unit in: the sum of its scenarios' differences, each in [-1, 1].

        What comes after the decision counts no more.
        """
        if self.decided_after is not None:
            return
        self.steps.append(round(total * self._grid))
        self.scenarios += scenarios
        bound, chance = self._walk.add(self.steps[-1])
        self._waiting.append((1 + total / scenarios) / 2)
        at = self._walk.at
        if abs(at) >= bound:
            self.decided_after = len(self.steps)
        if abs(at) >= bound or len(self.steps) >= self.planned:
            self.p = min(chance, 1.0)

    @property
    def difference(self) -> Estimate:
        """Mean difference so far with its confidence sequence, NaN before the first unit."""
        if not self.scenarios:
            return UNDEFINED
        while self._waiting:
            self._mean.add(self._waiting.pop(0))
        value = self._walk.at / (self.scenarios * self._grid)
        found = self._mean.estimate
        return Estimate(value, min(2 * found.low - 1, value), max(2 * found.high - 1, value))

    @property
    def differing(self) -> int:
        """Units on which the two differ."""
        return sum(step != 0 for step in self.steps)


class _Walk:
    """A walk, and the law of walks with steps of the same sizes and random signs that have crossed no
    boundary."""

    def __init__(self, units: int, error: float):
        self.at = 0
        self._units, self._error = units, error
        self._taken, self._spent = 0, 0.0
        self._law = np.ones(1)
        """(2 h + 1,) chances of the sums from -h to h."""

    def add(self, step: int) -> tuple[int, float]:
        """Takes a step.

        Returns:
            The boundary there, one beyond every sum where nothing may be spent; and the chance of having
            crossed before or of coming as far as this walk now.
        """
        self.at += step
        self._taken += 1
        size, law = abs(step), self._law
        if size:
            moved = np.zeros(len(law) + 2 * size)
            moved[: len(law)] += law / 2
            moved[2 * size :] += law / 2
            law = moved
        share = min(self._taken / self._units, 1.0) ** SPENDING
        left = self._error * share - self._spent
        half = len(law) // 2
        beyond = 2 * np.cumsum(law[half:][::-1])[::-1]  # from the sum 0, whose own chance counts twice, up
        inside = np.flatnonzero(beyond[1:] <= left + 1e-15)
        bound = int(inside[0]) + 1 if len(inside) else half + 1
        chance = self._spent + float(beyond[abs(self.at)]) if self.at else 1.0
        if bound <= half:
            self._spent += float(beyond[bound])
            law = law[half - bound + 1 : half + bound]
        self._law = law
        return bound, chance


class RateSequence:
    """Confidence sequence of a mean of numbers from 0 to 1, unit by unit.

    Args:
        level: confidence level, of all times together.
    """

    def __init__(self, level: float = LEVEL):
        m = _CANDIDATES[:, None]
        self._bets = np.concatenate([_STAKES / m, -_STAKES / (1 - m)], 1)
        """(candidates, bets): what is gained for each unit that a value exceeds the candidate by."""
        self._wealth = np.zeros_like(self._bets)
        """Logarithm of every bet's capital."""
        self._limit = 1 / (1 - level)
        self._low, self._high = 0.0, 1.0
        self._sum = 0.0
        self.count = 0

    def add(self, value: float) -> None:
        """Takes the next value in."""
        self.count += 1
        self._sum += value
        self._wealth += np.log1p(self._bets * (value - _CANDIDATES[:, None]))
        capital = np.exp(np.minimum(self._wealth, 700)).mean(1)
        kept = np.flatnonzero(capital < self._limit)
        if not len(kept):
            return
        # A candidate between two of the grid is left out only where both of them are.
        low = 0.0 if kept[0] == 0 else float(_CANDIDATES[kept[0] - 1])
        high = 1.0 if kept[-1] == len(_CANDIDATES) - 1 else float(_CANDIDATES[kept[-1] + 1])
        self._low, self._high = max(self._low, low), min(self._high, high)

    @property
    def estimate(self) -> Estimate:
        """Mean so far with its interval, NaN before the first value."""
        if not self.count:
            return UNDEFINED
        value = self._sum / self.count
        return Estimate(value, min(self._low, value), max(self._high, value))


def whole_units(order: Sequence[str], members: dict[str, list[str]], there: set[str]) -> list[str]:
    """Units of the order up to the first that lacks a scenario.

    Args:
        order: of units, see `sequence`.
        members: scenarios of every unit.
        there: scenarios whose trials are all in.
    """
    taken = []
    for unit in order:
        if not there.issuperset(members[unit]):
            break
        taken.append(unit)
    return taken
