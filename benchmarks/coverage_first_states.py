"""Scenarios that share first states, as in the shipped sets: a part of `coverage.py`.

n first states, of which about a seventh have two to six scenarios (of Meta-World's 359 test scenarios 270
first states, 37 of them shared). An initial-state trial is the first state's: scenarios that share it have
the same outcome. Recovery trials are the scenarios' own, and those of one first state are alike. First states
with several scenarios are like the others, or harder, since failures of a policy make scenarios.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from coverage_settings import (
    POLICIES,
    RATIOS,
    SCATTER,
    SIZES,
    TRIALS,
    Line,
    alike,
    held,
    rng_of,
    scenario_rates,
    sign_flips,
    verdicts,
)

from lerobot_roborecover.analysis.stats.intervals import (
    difference_interval,
    rate_interval,
    ratio_interval,
    spread,
)
from lerobot_roborecover.analysis.stats.ranking import StartRates, rank_agreement
from lerobot_roborecover.analysis.stats.resampling import resample

MOST = 6
"""Scenarios of one first state, at most."""
SHARED = 37 / 270
COUNTS = {2: 11, 3: 12, 4: 3, 5: 10, 6: 1}
"""First states of Meta-World's larger test set by their number of scenarios, where they have several."""
RATES = (0.1, 0.3, 0.5, 0.7, 0.9)
HARDER = {"alike": 0.0, "shared ones harder": 1.0}


def members(rng: np.random.Generator, p: np.ndarray, harder: float) -> np.ndarray:
    """(replicates, n, MOST) bool: the scenarios of each first state.

    Args:
        rng: source.
        p: (replicates, n) rates of a policy from the first states.
        harder: from 0 to 1, how much likelier a hard first state is to be shared.
    """
    chance = SHARED * (1 - harder + harder * 2 * (1 - p))
    several = rng.choice(list(COUNTS), p.shape, p=np.array(list(COUNTS.values())) / sum(COUNTS.values()))
    size = np.where(rng.random(p.shape) < chance, several, 1)
    return np.arange(MOST) < size[..., None]


def first_states(replicates: int) -> Iterator[Line]:
    """Initial-state rates, their differences and tests, retention and inversions over first states; and the
    same over scenarios, which is not printed."""
    for n in SIZES:
        for k in TRIALS:
            for name, scatter in SCATTER.items():
                yield from _one_policy(n, k, name, scatter, replicates)
                yield from _pairs(n, k, name, scatter, replicates)
            yield from _inversions(n, k, max(100, replicates // 16))


def _one_policy(n: int, k: int, name: str, scatter: float | None, replicates: int) -> Iterator[Line]:
    unit = np.repeat(np.arange(n), MOST)
    for p in RATES:
        rng, setting = rng_of("first states", n, k, name, p), f"{k} trials, {name}, rate {p}"
        true = scenario_rates(rng, p, n, scatter, replicates)
        x = rng.binomial(k, true) / k
        there = members(rng, true, 0.0)
        yield held("initial rate", n, setting, rate_interval(spread(x)), p)
        each = np.where(there, x[..., None], np.nan).reshape(replicates, -1)
        yield held("initial rate, over scenarios", n, setting, rate_interval(spread(each)), p)
    for top, bottom in RATIOS:
        for how, harder in HARDER.items():
            rng = rng_of("first states' ratios", n, k, name, top, bottom, how)
            setting = f"{k} trials, {name}, {top} over {bottom}, {how}"
            x, y = _both_starts(rng, (top, bottom), n, k, scatter, harder, replicates)
            many = _both_starts(rng, (top, bottom), 200_000, 1, scatter, harder, 1, noise=False)
            truth = np.nansum(many[1]) / np.nansum(many[0])
            yield held("retention, first states shared", n, setting, ratio_interval(y, x, unit), truth)


def _both_starts(
    rng: np.random.Generator, rates: tuple[float, float], n: int, k: int, scatter: float | None,
    harder: float, replicates: int, *, noise: bool = True,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Initial-state and recovery rates, (replicates, n * MOST) each; NaN where there is no scenario."""
    recovery, initial = alike(rng, rates, n, scatter, replicates)
    there = members(rng, initial, harder)
    own = recovery[..., None] * np.ones(MOST)
    if scatter is not None:  # scenarios of one first state are alike, and not the same
        own = np.clip(own, 1e-9, 1 - 1e-9)
        own = rng.beta(4 * own, 4 * (1 - own))
    if noise:
        initial, own = rng.binomial(k, initial) / k, rng.binomial(k, own) / k
    x = np.where(there, initial[..., None], np.nan)
    return x.reshape(replicates, -1), np.where(there, own, np.nan).reshape(replicates, -1)


def _pairs(n: int, k: int, name: str, scatter: float | None, replicates: int) -> Iterator[Line]:
    for p in (0.1, 0.5, 0.9):
        rng, setting = rng_of("first states' pairs", n, k, name, p), f"{k} trials, {name}, rate {p}"
        true = scenario_rates(rng, p, n, scatter, replicates)
        y = rng.binomial(k, true[:, None], (replicates, POLICIES, n))
        d = y[:, 0] - y[:, 1]
        bounds = difference_interval(spread(d / k))
        yield held("difference of initial rates", n, setting, bounds, 0.0)

        def wrong(what: str, found: np.ndarray, n=n, setting=setting) -> Line:
            return Line(what, n, setting, float(found.mean()), np.nan, len(found), size=True)

        yield wrong("one initial pair", (verdicts(y[:, :2], k) != 0).any(1))
        yield wrong("15 initial pairs", (verdicts(y, k) != 0).any(1))
        there = members(rng, true, 0.0)
        each = np.where(there, d[..., None], 0).reshape(replicates, -1)
        yield wrong("one initial pair, over scenarios", sign_flips(each) < 0.05)


ORDERS = {
    "far apart": (np.linspace(0.2, 0.9, 6), np.linspace(0.2, 0.9, 6)),
    "close": (np.linspace(0.45, 0.55, 6), np.linspace(0.4, 0.5, 6)),
    "level initially, apart at recovery": (np.full(6, 0.5), np.linspace(0.2, 0.9, 6)),
    "two swapped": (np.array([0.9, 0.8, 0.65, 0.5, 0.35, 0.2]), np.array([0.7, 0.6, 0.2, 0.45, 0.35, 0.1])),
}
"""True rates of six policies from first states and from recovery points."""


def _inversions(n: int, k: int, count: int) -> Iterator[Line]:
    for name, orders in ORDERS.items():
        rng, setting = rng_of("first states' ranks", n, k, name), f"{k} trials, {name}"
        swaps = sum(
            (orders[0][a] - orders[0][b]) * (orders[1][a] - orders[1][b]) < 0
            for a, b in combinations(range(POLICIES), 2)
        )
        bounds = []
        for _ in range(count):
            there = members(rng, np.full((1, n), 0.5), 0.0)[0]
            # Recovery points of one first state are alike for a policy: beta-distributed around its rate.
            own = rng.beta(6 * orders[1], 6 * (1 - orders[1]), (n, POLICIES)).T
            of = np.repeat(np.arange(n), there.sum(1))
            x = rng.binomial(k, orders[0][:, None], (POLICIES, n)) / k
            y = rng.binomial(k, own[:, of]) / k
            names = tuple("abcdef")
            found = rank_agreement(
                StartRates(names, x, resample(np.arange(n), 400)),
                StartRates(names, y, resample(np.arange(len(of)), 400)),
            ).inversions
            bounds.append((found.low, found.high))
        yield held("rank inversions, first states shared", n, setting, np.array(bounds).T, swaps)
