"""Several training runs, or evaluation seeds, of one method: what they have in common, and how far they lie
apart.

A rate over the runs at hand says what these runs do. What the method does, with another run, is another
question, and its uncertainty has two parts that cross: other runs on these units, and these runs on other
units. The variance of the mean of R runs on U units is that between runs plus that between units, less their
common part, which both of them hold (the analysis of variance of a two-way layout; Owen 2007, "The pigeonhole
bootstrap", shows that resampling both counts it more than once). Degrees of freedom follow Satterthwaite's
rule, no more than `CAUTION` for each degree of freedom that the runs have; the intervals are then those of
`intervals.py`.

Beside it stands the hierarchical bootstrap (runs, units, scenarios within them, trials within these;
percentile bounds), as it is used in the field (rliable, Agarwal et al. 2021, resamples runs the same way).
With few runs it knows too little of how far others would lie, and covers less than it says
(docs/log/statistics.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.contrasts import Contrast, holm
from lerobot_roborecover.analysis.stats.intervals import (
    UNDEFINED,
    Estimate,
    WeightedMean,
    clean,
    difference_interval,
    difference_p,
    estimate_of,
    rate_interval,
)
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling
from lerobot_roborecover.analysis.stats.verdicts import LEAST_RUNS, ComparisonVerdict, method_verdict

CAUTION = 2.0
"""Most degrees of freedom of an interval for each that the runs have: a variance between two or three runs
is often far too small by chance, and would pass for a certain one (docs/statistics.md)."""
_DRAWS = 2000


@dataclass(frozen=True)
class RunRates:
    """One method's runs on N scenarios."""

    method: str
    runs: tuple[str, ...]
    """R names."""
    rates: np.ndarray
    """(R, N) in [0, 1]; NaN where a run was not made on a scenario."""
    trials: np.ndarray
    """(R, N) int."""


@dataclass(frozen=True)
class MethodContrast:
    """Method a minus method b, for other runs like these."""

    these_runs: Contrast
    """Of the runs at hand."""
    runs: tuple[int, int]
    difference: Estimate
    """With the interval for other runs on other units; NaN bounds where either has one run."""
    p: float
    """Two-sided, of that interval."""
    p_holm: float
    """Adjusted for all pairs of complete methods with enough runs; NaN for others."""

    @property
    def verdict(self) -> ComparisonVerdict:
        """What may be said of the two methods."""
        return method_verdict(self)

    def reversed(self) -> MethodContrast:
        """The same, b minus a."""
        d = self.difference
        turned = Estimate(-d.value, -d.high, -d.low)
        return replace(self, these_runs=self.these_runs.reversed(), runs=self.runs[::-1], difference=turned)


@dataclass(frozen=True)
class MethodRate:
    """A method's rate, in units of one."""

    method: str
    each: tuple[Estimate, ...]
    """Of every run, with the interval over units."""
    sd: float
    """Between the runs' rates, as observed."""
    noise: float
    """What that would be on average were the runs one and the same policy, and their trials alone differed;
    NaN where a scenario has but one trial."""
    lowest: float
    highest: float
    other_runs: Estimate
    """With the interval for other runs like these, on other units like these; NaN below two runs."""
    bootstrap: Estimate
    """With the percentile bounds of the hierarchical bootstrap."""


def run_rates(arm: Arm, panel: Panel, row: int, scheduled: int | None = None) -> RunRates:
    """Every run's rates on the scenarios of a panel; one run where the arm has no more.

    Args:
        arm: of the method.
        panel: whose scenarios, in its order.
        row: index of the arm in the panel.
        scheduled: trials that every scenario was to have in every run; see `make_panel`.
    """
    place = {s.id: n for n, s in enumerate(panel.scenarios)}
    runs = arm.runs or ((arm.title, arm.rows),)
    successes, trials = np.zeros((2, len(runs), len(place)), int)
    for r, (_, rows) in enumerate(runs):
        for trial in rows:
            if trial.scenario_id in place:
                successes[r, place[trial.scenario_id]] += trial.success
                trials[r, place[trial.scenario_id]] += 1
    if scheduled is not None:
        trials[:] = np.where(panel.trials[row] > 0, scheduled, 0)
    trials = np.where(panel.trials[row] > 0, trials, 0)
    rates = np.divide(successes, trials, out=np.full(trials.shape, np.nan), where=trials > 0)
    return RunRates(arm.policy, tuple(name for name, _ in runs), rates, trials)


def method_rate(found: RunRates, resampling: Resampling) -> MethodRate:
    """A method's rate over its runs.

    Args:
        found: its runs.
        resampling: of the scenarios.
    """
    each = resampling.rates(found.rates.T)
    means = np.array([e.value for e in each])
    crossed = crossed_spread(found.rates, resampling)
    interval = rate_interval(crossed, resampling.level)
    several = len(means) > 1
    return MethodRate(
        found.method,
        tuple(each),
        float(means.std(ddof=1)) if several else float("nan"),
        _noise(found),
        float(means.min()),
        float(means.max()),
        estimate_of(crossed.value, interval) if several else UNDEFINED,
        hierarchical_bootstrap(found, resampling) if several else UNDEFINED,
    )


def _noise(found: RunRates) -> float:
    """SD of a run's rate that its trials alone would make."""
    k = found.trials[0]
    pooled = found.trials.sum(0)
    if len(found.runs) < 2 or (found.trials < 2).any() or (found.trials != k).any():
        return float("nan")
    within = (found.rates * (1 - found.rates)).mean(0) * k / (k - 1)
    return float(np.sqrt((within / k).sum())) / len(pooled)


def crossed_spread(rates: np.ndarray, resampling: Resampling) -> WeightedMean:
    """The mean of R runs on N scenarios, and its variance for other runs on other units.

    Args:
        rates: (R, N); NaN where nothing was run, the same scenarios in all runs.
        resampling: of the N scenarios.

    Returns:
        Variance NaN with one run.
    """
    units = resampling.spread(rates.mean(0))
    runs, shared, count = _parts(rates, resampling)
    return _crossed(units, [(runs, count - 1)], shared)


def crossed_difference(a: np.ndarray, b: np.ndarray, resampling: Resampling) -> WeightedMean:
    """The mean difference of two methods' runs on the same N scenarios, for other runs on other units.

    Args:
        a: (R, N) rates of one method's runs.
        b: (S, N) of the other's.
        resampling: of the N scenarios.

    Returns:
        Variance NaN where either has one run.
    """
    units = resampling.spread(a.mean(0) - b.mean(0))
    parts = [_parts(x, resampling) for x in (a, b)]
    return _crossed(units, [(v, count - 1) for v, _, count in parts], sum(s for _, s, _ in parts))


def _parts(rates: np.ndarray, resampling: Resampling) -> tuple[float, float, int]:
    """Variance of the mean between runs, the part of it that units share, and the number of runs."""
    known = np.isfinite(rates).all(0)
    y, count = rates[:, known], len(rates)
    if count < 2 or not known.any():
        return float("nan"), float("nan"), count
    means = y.mean(1)
    residual = y - means[:, None] - y.mean(0) + y.mean()
    index = np.unique(resampling.index[known], return_inverse=True)[1]
    units = int(index.max()) + 1
    totals = np.stack([np.bincount(index, row, units) for row in residual])
    square = float((totals**2).sum()) / max((count - 1) * (units - 1), 1)
    return float(means.var(ddof=1)) / count, square * units / (count * y.shape[1] ** 2), count


def _crossed(units: WeightedMean, runs: Sequence[tuple[float, int]], shared: float) -> WeightedMean:
    between = sum(v for v, _ in runs)
    if math.isnan(between) or math.isnan(units.variance):
        return WeightedMean(units.value, float("nan"), 0, 0.0, 0.0)
    variance = max(between + units.variance - shared, between, units.variance)
    parts = sum(v * v / f for v, f in runs) + units.variance**2 / units.freedom
    own = sum(f for _, f in runs)
    # One scenario of each run: so many trials are independent for other runs on other scenarios, and no more.
    apart = min(min(f for _, f in runs) + 1, int(units.units))
    freedom = min(variance**2 / parts if parts > 0 else units.freedom, CAUTION * own, units.freedom)
    return WeightedMean(
        units.value, variance, units.units, units.effective, freedom, np.full(apart, 1 / apart)
    )


def method_contrasts(
    found: Sequence[Contrast], runs: Sequence[RunRates], panel: Panel, resampling: Resampling
) -> tuple[MethodContrast, ...]:
    """Contrasts of the methods behind contrasts of runs.

    Args:
        found: contrasts of the runs at hand.
        runs: of every policy of the panel, in its order.
        panel: the trials.
        resampling: of its scenarios.
    """
    rows = []
    for c in found:
        a, b = (runs[panel.arm(name)] for name in (c.a, c.b))
        known = np.isfinite(a.rates).all(0) & np.isfinite(b.rates).all(0)
        part = resampling.part(np.flatnonzero(known))
        spread_ = crossed_difference(a.rates[:, known], b.rates[:, known], part)
        estimate = estimate_of(spread_.value, difference_interval(spread_, resampling.level))
        rows.append((c, (len(a.runs), len(b.runs)), estimate, difference_p(spread_)))
    enough = [c.complete and not c.sequential and min(n) >= LEAST_RUNS for c, n, _, _ in rows]
    adjusted = np.full(len(rows), np.nan)
    known = np.array(enough, bool) & np.isfinite([p for *_, p in rows])
    adjusted[known] = holm(np.array([p for *_, p in rows])[known])
    return tuple(
        MethodContrast(c, counts, estimate, p, float(q))
        for (c, counts, estimate, p), q in zip(rows, adjusted, strict=True)
    )


def hierarchical_bootstrap(
    found: RunRates, resampling: Resampling, draws: int = _DRAWS, *, trials: bool = True
) -> Estimate:
    """Percentile bounds of a bootstrap of runs, of units, of scenarios within these and of trials within
    these.

    Args:
        found: a method's runs.
        resampling: of the scenarios: units, seed, level.
        draws: how many.
        trials: whether to draw the trials anew, too.
    """
    known = np.isfinite(found.rates).all(0)
    y, k = found.rates[:, known], found.trials[:, known]
    value = float(y.mean()) if known.any() else float("nan")
    index = np.unique(resampling.index[known], return_inverse=True)[1]
    count = int(index.max()) + 1 if len(index) else 0
    if count < 2 or len(y) < 2:
        return Estimate(value, float("nan"), float("nan"))
    rng, draws = np.random.default_rng(resampling.seed), min(draws, resampling.draws)
    members = [np.flatnonzero(index == u) for u in range(count)]
    single = count == len(index)
    means = np.empty(draws)
    for draw in range(draws):
        chosen = rng.integers(0, len(y), len(y))
        units = rng.integers(0, count, count)
        if single:
            scenarios = units
        else:
            drawn = [members[u][rng.integers(0, len(members[u]), len(members[u]))] for u in units]
            scenarios = np.concatenate(drawn)
        at = np.ix_(chosen, scenarios)
        means[draw] = (rng.binomial(k[at], y[at]) / k[at] if trials else y[at]).mean()
    low, high = np.quantile(means, [(1 - resampling.level) / 2, (1 + resampling.level) / 2])
    return Estimate(value, float(clean(low)), float(clean(high)))
