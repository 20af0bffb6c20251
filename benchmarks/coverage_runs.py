"""Runs of one method, and tests that are looked at: two parts of `coverage.py`, and what looking saves.

    python benchmarks/coverage.py --only runs --only looks   # coverage and size, two minutes
    python benchmarks/coverage_runs.py                       # power, and what a stop saves, a minute

Runs scatter on the logistic scale, in their mean and scenario by scenario, by the same amount each: 0, 0.3
and 0.8, which is up to 0, 7 and 18 points of a rate of one half. Tests that are looked at see every scenario
as it comes.
"""

from __future__ import annotations

from collections.abc import Iterator

import coverage_settings as settings
import numpy as np
from coverage_settings import Line, alike, held, rng_of, scenario_rates
from scipy import special

from lerobot_roborecover.analysis.sequential_pairs import watched_pair
from lerobot_roborecover.analysis.sequential_plan import SequentialPlan
from lerobot_roborecover.analysis.stats.intervals import (
    WeightedMean,
    difference_interval,
    difference_p,
    rate_interval,
)
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.runs import (
    RunRates,
    crossed_difference,
    crossed_spread,
    hierarchical_bootstrap,
)
from lerobot_roborecover.analysis.stats.sequential import RateSequence, SequentialTest
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING, LEAST_RUNS

RUNS = (2, 3, 5, 10)
BETWEEN = (0.0, 0.3, 0.8)
_STAKES = np.linspace(-0.98, 0.98, 99)


def method_rates(rng, p: float, n: int, k: int, runs: int, sd: float, samples: int) -> np.ndarray:
    """(samples, runs, n) observed rates of a method's runs on the same scenarios."""
    hard = special.logit(np.clip(scenario_rates(rng, p, n, 2.0, samples), 1e-6, 1 - 1e-6))[:, None]
    shift = rng.normal(0, sd, (samples, runs, 1)) + rng.normal(0, sd, (samples, runs, n))
    return rng.binomial(k, special.expit(hard + shift)) / k


def _mean_rate(p: float, sd: float) -> float:
    rng = rng_of("truth", p, sd)
    hard = special.logit(np.clip(rng.beta(2 * p, 2 * (1 - p), 400_000), 1e-6, 1 - 1e-6))
    return float(special.expit(hard + rng.normal(0, sd * np.sqrt(2), len(hard))).mean())


def _many(found: list[WeightedMean]) -> WeightedMean:
    return WeightedMean(
        *(np.array([getattr(f, name) for f in found]) for name in WeightedMean.__dataclass_fields__)
    )


def runs(replicates: int) -> Iterator[Line]:
    """Rate and difference for other runs like these, the hierarchical bootstrap, verdicts on methods."""
    count = max(50, replicates // 16)
    for n in settings.SIZES:
        units = resample(np.arange(n), 200)
        for k in settings.TRIALS:
            for p in (0.1, 0.5):
                for sd in BETWEEN:
                    truth = _mean_rate(p, sd)
                    for r in RUNS:
                        rng, setting = rng_of("runs", n, k, p, sd, r), f"{r} runs, {k} trials, rate {p}, {sd}"
                        y, z = (method_rates(rng, p, n, k, r, sd, count) for _ in range(2))
                        own = _many([crossed_spread(v, units) for v in y])
                        yield held("rate, runs like these", n, setting, rate_interval(own), truth)
                        apart = _many([crossed_difference(v, w, units) for v, w in zip(y, z, strict=True)])
                        yield held("difference, runs like these", n, setting, difference_interval(apart), 0.0)
                        if k == 5:
                            few = [
                                RunRates("", tuple(map(str, range(r))), v, np.full(v.shape, k))
                                for v in y[: count // 4]
                            ]
                            drawn = [hierarchical_bootstrap(found, units) for found in few]
                            bounds = np.array([(e.low, e.high) for e in drawn]).T
                            yield held("rate, hierarchical bootstrap", n, setting, bounds, truth)
                    yield from _methods(n, k, p, sd, count)


def _methods(n: int, k: int, p: float, sd: float, count: int) -> Iterator[Line]:
    """Wrong verdicts on two methods that are alike, of the least number of runs."""
    rng, setting = rng_of("methods", n, k, p, sd), f"{LEAST_RUNS} runs, {k} trials, rate {p}, {sd}"
    units = resample(np.arange(n), 200)
    y, z = (method_rates(rng, p, n, k, LEAST_RUNS, sd, count) for _ in range(2))
    d = np.rint((y - z).sum(1) * k).astype(int)
    these = (settings.sign_flips(d) < 0.05) & ((d != 0).sum(1) >= LEAST_DIFFERING)
    p_of = [difference_p(crossed_difference(v, w, units)) for v, w in zip(y, z, strict=True)]
    method = np.array(p_of) < 0.05
    yield Line("two methods, wrong verdict", n, setting, float((these & method).mean()), np.nan, count, True)
    yield Line("the same, from these runs alone", n, setting, float(these.mean()), np.nan, count, True)


def looks(replicates: int) -> Iterator[Line]:
    """The sequential test at all looks together, its interval, and the rate's confidence sequence."""
    count = max(50, replicates // 16)
    for n in settings.SIZES:
        for k in settings.TRIALS:
            for p in (0.1, 0.5):
                for name in ("equal", "beta 1"):
                    rng, setting = rng_of("looks", n, k, p, name), f"{k} trials, {name}, rate {p}"
                    a, b = (rng.binomial(k, t) for t in alike(rng, (p, p), n, settings.SCATTER[name], count))
                    tests = [_sequential(row, n, k) for row in a - b]
                    wrong = np.mean([t.decided_after is not None for t in tests])
                    yield Line("sequential test, all looks", n, setting, float(wrong), np.nan, count, True)
                    if k == 1 and name == "equal":
                        peeked = _peeked(a - b)
                        yield Line("a fixed test at every look", n, setting, peeked, np.nan, count, True)
                    if n >= 2 * LOOKS and name == "equal":
                        yield from _growing(a, b, n, k, setting)
            for p in ((0.02, 0.02), (0.02, 0.1), (0.3, 0.7), (0.5, 0.9)):
                rng, setting = rng_of("looks, apart", n, k, p), f"{k} trials, beta 4, rates {p[0]} and {p[1]}"
                a, b = (rng.binomial(k, t) for t in alike(rng, p, n, 4.0, count // 2))
                found = [_sequential(row, n, k).difference for row in a - b]
                bounds = np.array([(d.low, d.high) for d in found]).T
                yield held("difference, sequential", n, setting, bounds, p[0] - p[1])
        for p in (0.1, 0.5, 0.9):
            rng, some = rng_of("rate sequence", n, p), max(40, count // 4)
            found = []
            for row in rng.binomial(1, p, (some, n)):
                rate = RateSequence()
                for value in row:
                    rate.add(float(value))
                found.append((rate.estimate.low, rate.estimate.high))
            yield held("rate, confidence sequence", n, f"1 trial, rate {p}", np.array(found).T, p)


LOOKS = 10


def _growing(a: np.ndarray, b: np.ndarray, n: int, k: int, setting: str) -> Iterator[Line]:
    """Ten looks at two logs that both grow in the order of the set, planned beforehand, or for what is
    there."""
    names = [f"s{i:03d}" for i in range(n)]
    planned, grown = [], []
    for y in np.stack([a, b], 1):
        decided = np.zeros(2, bool)
        for look in range(1, LOOKS + 1):
            there = look * n // LOOKS
            panel = settings.panel_of(np.where(np.arange(n) < there, y, 0), k * (np.arange(n) < there))
            for kind, last in enumerate((n, there)):
                units = {name: f"scenario:{name}" for name in names[:last]}
                c = watched_pair(panel, (0, 1), 0.95, SequentialPlan(units, (k, k)))
                decided[kind] |= bool(c.p < 0.05 and c.differing >= LEAST_DIFFERING)
        planned.append(decided[0])
        grown.append(decided[1])
    for what, found in (
        ("sequential test, both logs growing, ten looks", planned),
        ("the same, planned for what is there", grown),
    ):
        yield Line(what, n, setting, float(np.mean(found)), np.nan, len(found), True)


def _sequential(row: np.ndarray, n: int, k: int) -> SequentialTest:
    test = SequentialTest(n, k)
    for step in row:
        test.add(step / k)
    return test


def _peeked(differences: np.ndarray) -> float:
    """Share of samples in which the fixed test has decided at some look."""
    ever = np.zeros(len(differences), bool)
    for t in range(LEAST_DIFFERING, differences.shape[1] + 1):
        ever |= settings.sign_flips(differences[:, :t]) < 0.05
    return float(ever.mean())


def savings(count: int = 300) -> str:
    """Markdown: power of one look at the end, of the sequential test, of a betting e-process; scenarios."""
    rows = [
        "| scenarios | trials | rates | one look | sequential | its scenarios | e-process | its scenarios |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for n in (64, 200):
        for k in settings.TRIALS:
            for p in ((0.5, 0.5), (0.5, 0.6), (0.5, 0.7), (0.3, 0.6)):
                rng = rng_of("savings", n, k, p)
                a, b = (rng.binomial(k, t) for t in alike(rng, p, n, 1.0, count))
                one = np.mean(settings.sign_flips(b - a) < 0.05)
                tests = [_sequential(row, n, k) for row in b - a]
                share = np.mean([t.decided_after is not None for t in tests])
                run = np.mean([t.decided_after or n for t in tests])
                # A gambler with 99 stakes at once against "no difference": Ville's inequality at 20.
                wealth = np.exp(np.cumsum(np.log1p(_STAKES[:, None, None] * (b - a) / k), -1)).mean(0) >= 20
                first = np.where(wealth.any(1), wealth.argmax(1) + 1, n)
                rows.append(
                    f"| {n} | {k} | {p[0]:g}, {p[1]:g} | {100 * one:.0f} % | {100 * share:.0f} % "
                    f"| {run:.0f} | {100 * wealth.any(1).mean():.0f} % | {first.mean():.0f} |"
                )
    return "\n".join(rows)


if __name__ == "__main__":
    print(savings())
