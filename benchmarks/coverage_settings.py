"""Made-up policies with known rates, and how often intervals and tests hold of them: the parts of
`coverage.py`.

Every part measures many settings, each with random draws of its own, seeded by the setting's name. A part
gives all samples of a setting to the estimators at once where these take columns.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from lerobot_roborecover.analysis.stats.contrasts import holm
from lerobot_roborecover.analysis.stats.intervals import (
    RARE,
    difference_interval,
    rate_interval,
    ratio_interval,
    spread,
)
from lerobot_roborecover.analysis.stats.macro import LEAST_IN_CELL
from lerobot_roborecover.analysis.stats.panel import Panel, ScenarioLabels
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.retries import share_within
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING

SIZES = (8, 20, 64, 200)
TRIALS = (1, 5)
RATES = (0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.98)
SCATTER = {"equal": None, "beta 4": 4.0, "beta 1": 1.0}
"""Concentration of the beta distribution of the scenarios' rates."""
PAIRS = ((0.02, 0.02), (0.02, 0.1), (0.1, 0.1), (0.1, 0.3), (0.5, 0.5), (0.3, 0.7), (0.02, 0.98), (0.5, 0.9))
RATIOS = ((0.1, 0.3), (0.3, 0.5), (0.5, 0.9), (0.9, 0.95), (0.05, 0.9))
CELLS = (25, 49, 21, 28, 12, 16, 7, 31, 11)
"""Scenarios by cell on the paper's LIBERO test set; smaller sets have the same shares."""
POLICIES = 6


@dataclass(frozen=True)
class Line:
    """One setting of one interval or test."""

    what: str
    n: int
    setting: str
    share: float
    """Intervals that hold the truth; or families, or tests, that are wrong."""
    width: float
    """Mean width; NaN of a test."""
    samples: int
    """Samples that had an interval."""
    size: bool = False
    """Whether it is a test."""


def rng_of(*names: object) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(repr(names).encode()))


def scenario_rates(rng, p, n: int, scatter: float | None, replicates: int) -> np.ndarray:
    """(replicates, n) true rates with mean p, a number or (replicates, n)."""
    p = np.broadcast_to(p, (replicates, n))
    if scatter is None:
        return p
    p = np.clip(p, 1e-9, 1 - 1e-9)
    return rng.beta(p * scatter, (1 - p) * scatter)


def alike(rng, p: tuple[float, ...], n: int, scatter: float | None, replicates: int) -> list[np.ndarray]:
    """Policies' true rates, which rise and fall together in part (a normal copula, correlation .5)."""
    if scatter is None:
        return [np.full((replicates, n), q) for q in p]
    common = rng.standard_normal((replicates, n))
    grid = np.linspace(0, 1, 4001)
    found = []
    for q in p:
        own = (common + rng.standard_normal((replicates, n))) / np.sqrt(2)
        table = stats.beta.ppf(grid, q * scatter, (1 - q) * scatter)
        found.append(np.interp(stats.norm.cdf(own), grid, table))
    return found


def tasks_of(n: int) -> np.ndarray:
    """(n,) tasks of unequal size, four scenarios each on average, at least four tasks."""
    count = max(4, n // 4)
    rng = np.random.default_rng(7)
    more = rng.choice(count, n - count, p=rng.dirichlet(np.full(count, 4.0)))
    return np.sort(np.concatenate([np.arange(count), more]))


def cells_of(n: int) -> np.ndarray:
    """(n,) cells in the shares of the paper's set, as many as have the least number of scenarios each."""
    count = min(len(CELLS), max(1, n // LEAST_IN_CELL))
    share, more = np.cumsum(CELLS[:count]) / sum(CELLS[:count]), n - count * LEAST_IN_CELL
    beyond = np.searchsorted(share, (np.arange(more) + 0.5) / more)
    return np.sort(np.concatenate([np.repeat(np.arange(count), LEAST_IN_CELL), beyond]))


def held(what: str, n: int, setting: str, bounds, truth) -> Line:
    """One line: lower and upper bounds, (replicates,) each, and the truth, one number or one a sample."""
    low, high = np.asarray(bounds, float)
    known = np.isfinite(low) & np.isfinite(high)
    truth = np.broadcast_to(truth, low.shape)[known]
    low, high = low[known], high[known]
    inside = (low <= truth + 1e-12) & (truth <= high + 1e-12)
    return Line(what, n, setting, float(inside.mean()), float((high - low).mean()), int(known.sum()))


def rate_settings() -> Iterator[tuple[int, int, str, float | None, float]]:
    for n in SIZES:
        for k in TRIALS:
            for name, scatter in SCATTER.items() if k > 1 else [("equal", None)]:
                for p in RATES:
                    yield n, k, name, scatter, p


def rates(replicates: int) -> Iterator[Line]:
    """RSR, initial-state rate, cells, groups, budgets, shares of trials: one interval for all of them."""
    for n, k, name, scatter, p in rate_settings():
        rng = rng_of("rates", n, k, name, p)
        y = rng.binomial(k, scenario_rates(rng, p, n, scatter, replicates)) / k
        yield held("rate", n, f"{k} trials, {name}, rate {p}", rate_interval(spread(y)), p)


def retries(replicates: int) -> Iterator[Line]:
    """RSR@k, success within k attempts: its estimand is the mean over scenarios of 1 - (1 - rate)^k."""
    trials = 5
    for n in SIZES:
        for name, scatter in SCATTER.items():
            for p in RATES:
                for k in (2, 3, 5):
                    rng, setting = rng_of("retries", n, k, name, p), f"{k} of {trials}, {name}, rate {p}"
                    solved = rng.binomial(trials, scenario_rates(rng, p, n, scatter, replicates))
                    lost = (1 - p) ** k
                    if scatter is not None:  # the k-th moment of the beta distribution of 1 - rate
                        j = np.arange(k)
                        lost = np.prod(((1 - p) * scatter + j) / (scatter + j))
                    within = share_within(solved, np.full(solved.shape, trials), k)
                    yield held("RSR@k", n, setting, rate_interval(spread(within), rare=RARE), 1 - lost)


def bootstrap(replicates: int) -> Iterator[Line]:
    """The paper's percentile bootstrap, to compare with."""
    for n, k, name, scatter, p in rate_settings():
        rng, setting = rng_of("rates", n, k, name, p), f"{k} trials, {name}, rate {p}"
        y = rng.binomial(k, scenario_rates(rng, p, n, scatter, replicates)) / k
        # One set of draws serves all samples: each sample sees random draws, which is all that its interval
        # is made of.
        drawn = resample(np.arange(n), 1000).means(y.T)
        low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
        yield held("rate, percentile bootstrap", n, setting, (low, high), p)


def with_tasks(replicates: int) -> Iterator[Line]:
    """The same where tasks scatter: over scenarios for these tasks, over tasks for others like these."""
    for n in SIZES:
        task = tasks_of(n)
        for k in TRIALS:
            for name, scatter in SCATTER.items():
                for p in RATES:
                    rng, setting = rng_of("tasks", n, k, name, p), f"{k} trials, {name}, rate {p}"
                    of_task = rng.beta(4 * p, 4 * (1 - p), (replicates, task.max() + 1))[:, task]
                    y = rng.binomial(k, scenario_rates(rng, of_task, n, scatter, replicates)) / k
                    bounds = rate_interval(spread(y))
                    yield held("rate, of these tasks", n, setting, bounds, of_task.mean(1))
                    yield held("rate, tasks like these", n, setting, rate_interval(spread(y, task)), p)


def macro(replicates: int) -> Iterator[Line]:
    """Macro over up to nine cells of unlike size and rate, and with a smallest one unlike the others."""
    for n in SIZES:
        cell = cells_of(n)
        labels = np.unique(cell)
        for k in TRIALS:
            for name, scatter in SCATTER.items() if k > 1 else [("equal", None)]:
                for p in (0.05, 0.2, 0.5, 0.8, 0.95):
                    rng, setting = rng_of("macro", n, k, name, p), f"{k} trials, {name}, rate about {p}"
                    of_cell = rng_of(n, p).beta(6 * p, 6 * (1 - p), 9)
                    y = rng.binomial(k, scenario_rates(rng, of_cell[cell], n, scatter, replicates)) / k
                    # The mean over cells is of the cells as they are: their scenarios are what is drawn.
                    bounds = rate_interval(spread(y, cells=cell))
                    yield held("Macro", n, setting, bounds, of_cell[labels].mean())
    yield from small_cell(replicates, LEAST_IN_CELL)


def small_cell(replicates: int, size: int) -> Iterator[Line]:
    """Macro over the paper's nine cells, the smallest of which has so many scenarios and a rate of its own.

    What `LEAST_IN_CELL` was chosen by: `python benchmarks/coverage.py --small-cells`.
    """
    sizes = np.array([size, *sorted(CELLS)[1:]])
    cell, n = np.repeat(np.arange(len(sizes)), sizes), 200
    for k in TRIALS:
        for name in ("equal", "beta 1"):
            for own in (0.05, 0.2, 0.5, 0.8, 0.95):
                for others in (0.03, 0.1, 0.3, 0.5, 0.9):
                    rng = rng_of("small cell", size, k, name, own, others)
                    setting = f"{k} trials, {name}, rate {own} of {size} scenarios, {others} of the others"
                    p = np.where(cell == 0, own, others)
                    y = rng.binomial(k, scenario_rates(rng, p, len(cell), SCATTER[name], replicates)) / k
                    truth = (own + (len(sizes) - 1) * others) / len(sizes)
                    bounds = rate_interval(spread(y, cells=cell))
                    yield held("Macro, its smallest cell unlike the others", n, setting, bounds, truth)


def differences(replicates: int) -> Iterator[Line]:
    """Paired differences: contrasts, gains of interventions; over scenarios and over tasks."""
    for n in SIZES:
        task = tasks_of(n)
        for k in TRIALS:
            for p in PAIRS:
                rates, truth = f"rates {p[0]} and {p[1]}", p[0] - p[1]
                for name, scatter in SCATTER.items():
                    rng = rng_of("pairs", n, k, name, p)
                    a, b = (rng.binomial(k, t) / k for t in alike(rng, p, n, scatter, replicates))
                    bounds = difference_interval(spread(a - b))
                    yield held("difference", n, f"{k} trials, {name}, {rates}", bounds, truth)
                rng = rng_of("pairs of tasks", n, k, p)
                of_task = alike(rng, p, task.max() + 1, 4.0, replicates)
                a, b = (rng.binomial(k, t[:, task]) / k for t in of_task)
                bounds = difference_interval(spread(a - b, task))
                yield held("difference, tasks like these", n, f"{k} trials, {rates}", bounds, truth)


def ratios(replicates: int) -> Iterator[Line]:
    """Retention."""
    for n in SIZES:
        for k in TRIALS:
            for p in RATIOS:
                for name, scatter in SCATTER.items():
                    rng, setting = rng_of("ratios", n, k, name, p), f"{k} trials, {name}, {p[0]} over {p[1]}"
                    top, bottom = (rng.binomial(k, t) / k for t in alike(rng, p, n, scatter, replicates))
                    yield held("retention", n, setting, ratio_interval(top, bottom), p[0] / p[1])


def steps(replicates: int) -> Iterator[Line]:
    """Extra steps of an intervention: horizon 300, solved trials end somewhere before it."""
    for n in SIZES:
        for k in TRIALS:
            for p in PAIRS:
                rng, setting = rng_of("steps", n, k, p), f"{k} trials, rates {p[0]} and {p[1]}"
                shape = (replicates, n, k)
                used = [np.where(rng.random(shape) < q, rng.integers(20, 300, shape), 300) for q in p]
                y = used[0].mean(2) - used[1].mean(2)
                truth = (159.5 - 300) * (p[0] - p[1])
                yield held(
                    "extra steps", n, setting, difference_interval(spread(y / 300)), truth / 300
                )  # fmt: skip


def tests(replicates: int) -> Iterator[Line]:
    """Wrong verdicts of one pair, and of a family of 15, of policies that are alike."""
    for n in SIZES:
        task = tasks_of(n)
        for k in TRIALS:
            for p in (0.1, 0.5):

                def wrong(what: str, setting: str, successes: np.ndarray, n=n, k=k) -> Line:
                    found = (verdicts(successes, k) != 0).any(1)
                    return Line(what, n, setting, float(found.mean()), np.nan, len(found), size=True)

                for name in ("equal", "beta 1"):
                    rng, setting = rng_of("size", n, k, name, p), f"{k} trials, {name}, rate {p}"
                    true = scenario_rates(rng, p, n, SCATTER[name], replicates)
                    y = rng.binomial(k, true[:, None], (replicates, POLICIES, n))
                    yield wrong("one pair", setting, y[:, :2])
                    yield wrong("15 pairs", setting, y)
                setting = f"{k} trials, rate {p}"
                apart = scenario_rates(rng, p, POLICIES * n, 1.0, replicates).reshape(-1, POLICIES, n)
                y = rng.binomial(k, apart)
                yield wrong("15 pairs, each finds other scenarios hard", setting, y)
                of_task = scenario_rates(rng, p, POLICIES * (task.max() + 1), 4.0, replicates)
                y = rng.binomial(k, of_task.reshape(replicates, POLICIES, -1)[:, :, task])
                sums = np.add.reduceat(y, np.flatnonzero(np.diff(task, prepend=-1)), axis=-1)
                yield wrong("15 pairs, over tasks", setting, sums)


def verdicts(successes: np.ndarray, most: int, error: float = 0.05) -> np.ndarray:
    """(families, pairs) which policy is shown to be ahead: 1, -1, or 0 for neither.

    Args:
        successes: (families, policies, units) int.
        most: differences are that many at most, or a little more; only speed depends on it.
        error: of the family.
    """
    pairs = list(combinations(range(successes.shape[1]), 2))
    d = np.stack([successes[:, a] - successes[:, b] for a, b in pairs], 1)
    p = sign_flips(d.reshape(-1, d.shape[2])).reshape(d.shape[:2])
    shown = (holm(p) < error) & ((d != 0).sum(2) >= LEAST_DIFFERING)
    return np.where(shown, np.sign(d.sum(2)), 0)


def sign_flips(differences: np.ndarray) -> np.ndarray:
    """(samples,) exact p-values as of `analysis.stats.permutation.sign_flip_p`, of many samples at once.

    The sum of flipped differences has the characteristic function prod cos(t d); its chances follow from
    as many values of t as the sum has values.

    Args:
        differences: (samples, units) int.
    """
    size = np.abs(differences)
    most = int(size.max(initial=0))
    counts = np.stack([(size == v).sum(1) for v in range(1, most + 1)], 1) if most else size[:, :0]
    # The tail depends on the counts and on the sum alone.
    keys, back = np.unique(np.column_stack([counts, np.abs(differences.sum(1))]), axis=0, return_inverse=True)
    p = np.ones(len(keys))
    points = int((keys[:, :-1] @ np.arange(1, most + 1)).max(initial=0)) + 1
    t = np.pi * np.arange(1, points) / points
    cosine = np.cos(np.outer(np.arange(1, most + 1), t))
    log, negative = np.log(np.maximum(np.abs(cosine), 1e-300)), (cosine < 0).astype(float)
    for first in range(0, len(keys), 2000):
        part = keys[first : first + 2000]
        number, observed = part[:, :-1].astype(float), part[:, -1:]
        phi = np.exp(number @ log) * (1 - 2 * ((number @ negative) % 2))
        nearer = (observed - 1) + (phi * np.sin((observed - 1) * t) / np.sin(t)).sum(1, keepdims=True)
        nearer = np.where(observed > 0, nearer, 0)
        p[first : first + 2000] = np.clip(1 - nearer[:, 0] / points, 0, 1)
    return p[back.ravel()]


def panel_of(successes: np.ndarray, trials: int | np.ndarray) -> Panel:
    """A panel of (policies, scenarios) successes; trials of every scenario, or of each."""
    labels = [
        ScenarioLabels(f"s{i:03d}", "libero", "", "", "", "", "", "", "", 300)
        for i in range(successes.shape[1])
    ]
    full = np.broadcast_to(trials, successes.shape)
    return Panel(tuple("abcdef"[: len(successes)]), tuple(labels), successes, full, np.zeros_like(full), {})
