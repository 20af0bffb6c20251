"""Parts of `coverage.py` about several policies at once: the oracle, differing profiles, ranks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from coverage_settings import POLICIES, SIZES, TRIALS, Line, held, panel_of, rng_of, scenario_rates
from scipy import stats

from lerobot_roborecover.analysis.stats.crossfit import gain_over, oracle, profile_difference
from lerobot_roborecover.analysis.stats.ranking import StartRates, rank_agreement
from lerobot_roborecover.analysis.stats.resampling import resample

CHOICES = {
    "5 trials, alike, rate 0.5": (5, [0.5] * POLICIES, None),
    "5 trials, alike, rate 0.1": (5, [0.1] * POLICIES, None),
    "5 trials, beta 1 each": (5, [0.5] * POLICIES, 1.0),
    "5 trials, one ahead": (5, [0.3, 0.3, 0.3, 0.3, 0.3, 0.5], 4.0),
    "2 trials, one ahead": (2, [0.3, 0.3, 0.3, 0.3, 0.3, 0.5], 4.0),
    "1 trial, alike, rate 0.5": (1, [0.5] * POLICIES, None),
    "1 trial, one ahead": (1, [0.3, 0.3, 0.3, 0.3, 0.3, 0.5], 4.0),
}
"""Trials, mean rates of the policies, and scatter of the scenarios, each policy's its own."""


def chosen(replicates: int) -> Iterator[Line]:
    """Cross-fitted oracle, profile difference and source gain, against what they are on average."""
    count = max(100, replicates // 4)
    for n in SIZES:
        draws = resample(np.arange(n))
        for setting, (k, p, scatter) in CHOICES.items():
            rng = rng_of("chosen", n, setting)
            found: dict[str, list] = {}
            for _ in range(count):
                y = rng.binomial(k, scenario_rates(rng, np.array(p)[:, None], n, scatter, POLICIES))
                panel = panel_of(y, k)
                others = list(range(1, POLICIES))
                gain = gain_over(panel.successes, panel.trials, 0, others, draws)
                found.setdefault("source gain", []).append(gain)
                if k > 1:
                    found.setdefault("oracle's gain", []).append(oracle(panel, draws).gain)
                    pair = profile_difference(panel, 0, 1, draws)
                    found.setdefault("profile difference", []).append(pair.difference)
            for what, every in found.items():
                no_gain = setting.split(",")[1] == " alike"
                truth = 0.0 if no_gain else float(np.mean([e.value for e in every]))
                bounds = np.array([(e.low, e.high) for e in every]).T
                yield held(f"{what}, cross-fitted", n, setting, bounds, truth)


ORDERS = {
    "far apart": (np.linspace(0.2, 0.9, 6), np.linspace(0.2, 0.9, 6)),
    "close": (np.linspace(0.45, 0.55, 6), np.linspace(0.4, 0.5, 6)),
    "two swapped": (np.array([0.9, 0.8, 0.65, 0.5, 0.35, 0.2]), np.array([0.7, 0.6, 0.2, 0.45, 0.35, 0.1])),
}
"""True rates of six policies from initial states and from recovery points."""


def ranks(replicates: int) -> Iterator[Line]:
    """Bounds of the rank inversions, and a percentile bootstrap of Spearman's rho, which is not printed."""
    count = max(100, replicates // 16)
    for n in SIZES:
        draws = resample(np.arange(n), 400)
        for k in TRIALS:
            for name, orders in ORDERS.items():
                rng, setting = rng_of("ranks", n, k, name), f"{k} trials, {name}"
                first, second = orders
                swaps = sum(
                    (first[a] - first[b]) * (second[a] - second[b]) < 0
                    for a, b in combinations(range(POLICIES), 2)
                )
                rho = stats.spearmanr(first, second).statistic
                bounds, bootstrapped = [], []
                for _ in range(count):
                    x, y = (rng.binomial(k, p[:, None], (POLICIES, n)) / k for p in orders)
                    rates = (StartRates(tuple("abcdef"), values, draws) for values in (x, y))
                    found = rank_agreement(*rates).inversions
                    bounds.append((found.low, found.high))
                    drawn = _rho(draws.means(x.T), draws.means(y.T))
                    # Rounding: a coefficient is one of few fractions.
                    low, high = np.nanquantile(drawn, [0.025, 0.975])
                    bootstrapped.append((low - 1e-9, high + 1e-9))
                yield held("rank inversions", n, setting, np.array(bounds).T, swaps)
                yield held("rho, percentile bootstrap", n, setting, np.array(bootstrapped).T, rho)


def _rho(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(draws,) Spearman's coefficients of (draws, policies) rates."""
    x, y = (stats.rankdata(v, axis=1) - (v.shape[1] + 1) / 2 for v in (x, y))
    size = np.sqrt((x**2).sum(1) * (y**2).sum(1))
    return np.divide((x * y).sum(1), size, out=np.full(len(size), np.nan), where=size > 0)
