"""How many scenarios and trials it takes to separate two policies, before any of them is run.

The test is the one that the report uses: sign flips of the scenarios' paired differences. Its statistic is
the sum of the differences, and given their sizes it is compared with the root of the sum of their squares, so
that with n scenarios, a mean difference d and a variance v between scenarios' differences the chance of
passing is, for the normal quantile z of the level,

    Phi((n d - z sqrt(n (v + d^2)) - 1 / trials) / sqrt(n v)).

The 1 / trials is half the distance between the sums that random signs can make, and z is taken a little
nearer, because these sums have shorter tails than the normal law (Cornish and Fisher 1938; their kurtosis is
-2 times the fourth moment of the differences over n times the square of the second, taken of a normal law). v
is the variance of the true difference between scenarios, plus what is left of the trials' own, E[p (1 - p)] /
trials for each policy. Scenarios' rates are beta-distributed, those of two policies correlated. The formula
is checked against the exact test by simulation (`simulated_power`; tests/analysis/test_power.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import LEVEL
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.permutation import differing, sign_flip_p
from lerobot_roborecover.analysis.stats.variance import variance_split
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING

POWER = 0.8
"""Chance of separating the two that is planned for unless another is asked for."""
MOST_SCENARIOS = 1_000_000
"""Beyond it a plan says that it takes more."""
SIMULATED_UP_TO = 2000
"""Most scenarios at which a plan is checked by simulation."""


@dataclass(frozen=True)
class PowerAssumptions:
    """What is believed of two policies and of the scenarios."""

    rate: float
    """Rate of the one that is thought to be worse, in (0, 1)."""
    sd: float
    """Standard deviation of a policy's true rates between scenarios, at `rate`: 0 where all are equally hard,
    sqrt(rate (1 - rate)) where every scenario is always or never solved."""
    correlation: float
    """Of the two policies' true rates over scenarios, from 0 up: 1 where both find the same ones hard."""

    def __post_init__(self):
        if not 0 < self.rate < 1:
            raise RowsError(f"--rate={100 * self.rate:g} is not between 0 and 100 per cent")
        most = math.sqrt(self.rate * (1 - self.rate))
        if not 0 <= self.sd <= most + 1e-9:
            raise RowsError(
                f"--sd={100 * self.sd:g}: rates of {100 * self.rate:g} % on average cannot scatter by more "
                f"than {100 * most:.1f} points (every scenario always or never solved)"
            )
        if not 0 <= self.correlation <= 1:
            raise RowsError(f"--correlation={self.correlation:g} is not from 0 to 1")

    @property
    def share(self) -> float:
        """Variance between scenarios as a share of the most that it can be."""
        return min(self.sd**2 / (self.rate * (1 - self.rate)), 1.0)


@dataclass(frozen=True)
class Plan:
    """What one number of trials a scenario takes."""

    trials: int
    difference: float
    """True difference, in units of one."""
    scenarios: int | None
    """That separate it with the wanted power; None where it takes more than `MOST_SCENARIOS`."""
    power: float
    """Power by the formula, at so many scenarios."""
    simulated: float
    """With the exact test, by simulation; NaN where there are too many scenarios."""


def variance_of_difference(guess: PowerAssumptions, difference: float, trials: int) -> float:
    """Variance between scenarios of the observed paired difference.

    Args:
        guess: of the two.
        difference: of the better one, over `guess.rate`.
        trials: of each policy on a scenario.
    """
    own = [p * (1 - p) for p in (guess.rate, guess.rate + difference)]
    between = [guess.share * v for v in own]
    within = sum(v - b for v, b in zip(own, between, strict=True))
    return sum(between) - 2 * guess.correlation * math.sqrt(between[0] * between[1]) + within / trials


def power(
    guess: PowerAssumptions,
    difference: float,
    scenarios: float,
    trials: int,
    level: float = LEVEL,
    family: int = 1,
) -> float:
    """Chance that the sign-flip test separates the two, by the formula above.

    Args:
        guess: of the two.
        difference: true, in units of one.
        scenarios: how many.
        trials: of each policy on a scenario.
        level: confidence level.
        family: pairs that p is adjusted for; this one is taken to be the first of Holm's rule, which gets the
            level divided by their number.
    """
    n, d, variance = scenarios, abs(difference), variance_of_difference(guess, difference, trials)
    z = stats.norm.isf((1 - level) / family / 2)
    second = variance + d * d
    if variance < 1e-12:
        return float(2 ** (1 - min(n, 1000.0)) < (1 - level) / family)
    fourth = 3 * variance**2 + 6 * variance * d * d + d**4
    z -= (z**3 - 3 * z) * fourth / second**2 / (12 * n)
    top = n * d - z * math.sqrt(n * second) - 1 / trials
    return float(stats.norm.cdf(top / math.sqrt(n * variance)))


def scenarios_for(
    guess: PowerAssumptions,
    difference: float,
    trials: int,
    wanted: float = POWER,
    level: float = LEVEL,
    family: int = 1,
) -> int | None:
    """Least number of scenarios with the wanted power; None where it is more than `MOST_SCENARIOS`."""
    if power(guess, difference, MOST_SCENARIOS, trials, level, family) < wanted:
        return None
    low, high = LEAST_DIFFERING - 1, MOST_SCENARIOS
    while high - low > 1:
        middle = (low + high) // 2
        enough = power(guess, difference, middle, trials, level, family) >= wanted
        low, high = (low, middle) if enough else (middle, high)
    return high


def detectable(
    guess: PowerAssumptions,
    scenarios: int,
    trials: int,
    wanted: float = POWER,
    level: float = LEVEL,
    family: int = 1,
) -> float:
    """Least true difference that a set of scenarios separates with the wanted power; NaN where none does."""
    most = 1 - guess.rate - 1e-9

    def lacking(difference: float) -> float:
        return power(guess, difference, scenarios, trials, level, family) - wanted

    return float(optimize.brentq(lacking, 1e-9, most)) if lacking(most) > 0 else float("nan")


def simulated_power(
    guess: PowerAssumptions,
    difference: float,
    scenarios: int,
    trials: int,
    level: float = LEVEL,
    family: int = 1,
    *,
    samples: int = 300,
    seed: int = 0,
) -> float:
    """The same with the exact test on made-up policies: the share of samples with a verdict.

    Args:
        guess, difference, scenarios, trials, level, family: as for `power`.
        samples: how many.
        seed: of the samples.
    """
    rng = np.random.default_rng(seed)
    first, second = true_rates(rng, guess, difference, (samples, scenarios))
    found = rng.binomial(trials, second) - rng.binomial(trials, first)
    alpha = (1 - level) / family
    return float(
        np.mean([differing(row) >= LEAST_DIFFERING and sign_flip_p(row / trials) < alpha for row in found])
    )


def true_rates(
    rng: np.random.Generator, guess: PowerAssumptions, difference: float, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """True rates of two policies on scenarios: beta-distributed, coupled by a normal copula whose correlation
    is chosen so that the rates' own is the guess's.

    Args:
        rng: source.
        guess: of the two.
        difference: of the second over the first.
        shape: (samples, scenarios).
    """
    means = guess.rate, guess.rate + difference
    if guess.share < 1e-9:
        return np.full(shape, means[0]), np.full(shape, means[1])
    table = _quantiles(means, guess.share)
    copula = _copula(table, guess.correlation)
    z = rng.standard_normal(shape)
    other = copula * z + math.sqrt(1 - copula**2) * rng.standard_normal(shape)
    grid = _grid()
    return np.interp(stats.norm.cdf(z), grid, table[0]), np.interp(stats.norm.cdf(other), grid, table[1])


def _grid() -> np.ndarray:
    return (np.arange(4000) + 0.5) / 4000


def _quantiles(means: Sequence[float], share: float) -> list[np.ndarray]:
    concentration = max(1 / share - 1, 1e-6)
    return [stats.beta.ppf(_grid(), m * concentration, (1 - m) * concentration) for m in means]


def _copula(table: Sequence[np.ndarray], wanted: float) -> float:
    """Correlation of the normals that gives the rates the wanted one, or the nearest."""
    rng = np.random.default_rng(1)
    z, e = rng.standard_normal((2, 20_000))

    def reached(c: float) -> float:
        other = c * z + math.sqrt(1 - c * c) * e
        both = [np.interp(stats.norm.cdf(x), _grid(), q) for x, q in zip((z, other), table, strict=True)]
        return float(np.corrcoef(np.stack(both))[0, 1]) - wanted

    if reached(0.0) >= 0:
        return 0.0
    return 1.0 if reached(1.0) <= 0 else float(optimize.brentq(reached, 0.0, 1.0, xtol=1e-3))


def plans(
    guess: PowerAssumptions,
    differences: Sequence[float],
    trials: Sequence[int],
    wanted: float = POWER,
    level: float = LEVEL,
    family: int = 1,
) -> list[Plan]:
    """For every difference and number of trials, the scenarios that it takes.

    Raises:
        RowsError: a difference that the rate leaves no room for.
    """
    found = []
    for d in differences:
        if not 0 < d < 1 - guess.rate:
            raise RowsError(
                f"--difference={100 * d:g}: with a rate of {100 * guess.rate:g} % it must be above 0 and "
                f"below {100 * (1 - guess.rate):g} points. Name the rate of the worse one"
            )
        for k in trials:
            n = scenarios_for(guess, d, k, wanted, level, family)
            checked = float("nan")
            if n is not None and n <= SIMULATED_UP_TO:
                checked = simulated_power(guess, d, n, k, level, family)
            found.append(
                Plan(k, d, n, float("nan") if n is None else power(guess, d, n, k, level, family), checked)
            )
    return found


def guess_from(panel: Panel, rate: float | None = None, correlation: float | None = None) -> PowerAssumptions:
    """What a pilot says: rate, scatter between scenarios net of the trials' own, and the two's correlation.

    The difference that the pilot shows is no part of it: to plan for that one says what is known already.

    Args:
        panel: trials of one policy or two from one start.
        rate: instead of the pilot's.
        correlation: instead of the pilot's; half where the pilot has one policy.

    Raises:
        RowsError: no scenario has two trials, so that scenarios cannot be distinguished from trials.
    """
    splits = [variance_split(panel.successes[p], panel.trials[p]) for p in range(min(len(panel.arms), 2))]
    if any(math.isnan(s.between) for s in splits):
        raise RowsError(
            "the pilot has one trial a scenario (or one scenario), which does not tell how scenarios differ "
            "from how trials do. Say --rate and --sd, or run at least two trials of some scenarios"
        )
    means = [float(np.nanmean(panel.rates[p])) for p in range(len(splits))]
    shares = [s.between / max(m * (1 - m), 1e-9) for s, m in zip(splits, means, strict=True)]
    own = min(means) if rate is None else rate
    if not 0 < own < 1:
        raise RowsError(f"the pilot's rate is {100 * own:g} %: say with --rate what to expect")
    found = 0.5
    if correlation is not None:
        found = correlation
    elif len(splits) == 2:
        both = np.isfinite(panel.rates[:2]).all(0)
        # Trials of two policies are drawn apart: their covariance is that of the true rates.
        spread = math.sqrt(splits[0].between * splits[1].between)
        covariance = float(np.cov(panel.rates[:2, both])[0, 1]) if both.sum() > 1 else 0.0
        found = min(max(covariance / spread, 0.0), 1.0) if spread > 1e-9 else 0.0
    share = min(max(float(np.mean(shares)), 0.0), 1.0)
    return PowerAssumptions(own, math.sqrt(share * own * (1 - own)), found)
