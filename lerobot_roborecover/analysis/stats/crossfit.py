"""What is chosen on the data and scored on other data: oracle, profile difference, gain of the best
alternative.

The highest of several noisy rates is too high: six policies that toss the same coin show an "oracle" far
above each of them. So the trials of every scenario are divided at random in two halves; one half chooses, the
other one is scored, and the other way round, over many divisions. Beside it stands what the choice shows on
its own trials, in hindsight, and how much of that chance alone would show (the noise floor): the same trials
dealt at random to the policies, scenario by scenario.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate, difference_interval, estimate_of
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling, masked_mean

SPLITS = 100
"""Random divisions of the trials; each is used in both directions."""
_NAN = float("nan")
_NOBODY = Estimate(_NAN, _NAN, _NAN)


@dataclass(frozen=True)
class SplitHalves:
    """Rates in two halves of every scenario's trials, for S random divisions."""

    choosing: np.ndarray
    """(S, P, N) in [0, 1]; NaN where there are fewer than two trials."""
    scored: np.ndarray
    """(S, P, N) in [0, 1] on the other half."""


def halves(successes: np.ndarray, trials: np.ndarray, seed: int) -> SplitHalves:
    """Divides trials at random; every division is there in both directions.

    Args:
        successes: (P, N) int.
        trials: (P, N) int.
        seed: of the divisions.
    """
    rng = np.random.default_rng(seed)
    small = trials // 2
    first = rng.hypergeometric(successes, trials - successes, small, size=(SPLITS, *trials.shape))
    with np.errstate(invalid="ignore", divide="ignore"):
        some = np.where(small > 0, first / small, np.nan)
        rest = np.where(small > 0, (successes - first) / (trials - small), np.nan)
    return SplitHalves(np.concatenate([some, rest]), np.concatenate([rest, some]))


def permutation_null(successes: np.ndarray, trials: np.ndarray, seed: int) -> np.ndarray:
    """(S, P, N) rates had the trials of every scenario been dealt to the policies at random: all policies
    alike."""
    rng = np.random.default_rng(seed)
    left_won, left = successes.sum(0), trials.sum(0)
    won = np.broadcast_to(left_won, (SPLITS, len(left_won))).copy()
    rates = np.full((SPLITS, *trials.shape), np.nan)
    for p, count in enumerate(trials):
        own = rng.hypergeometric(won, left - won, np.broadcast_to(count, won.shape))
        rates[:, p] = np.divide(own, count, out=np.full(own.shape, np.nan), where=count > 0)
        won, left = won - own, left - count
    return rates


@dataclass(frozen=True)
class Oracle:
    """The best policy of every scenario against the best policy of all."""

    scenarios: int
    best_policy: str
    """Highest rate on all trials."""
    best_rate: Estimate
    rate: Estimate
    """Chosen scenario by scenario on half of the trials, scored on the other half; NaN with single trials."""
    fixed: Estimate
    """The best policy of all, chosen and scored the same way."""
    gain: Estimate
    """The one minus the other: what choosing by scenario is worth. Not deployable either: it takes trials."""
    hindsight: Estimate
    """The highest observed rate: chosen and scored on the same trials, and so too high."""
    hindsight_gain: Estimate
    floor: Estimate
    """What `hindsight_gain` is by chance alone, were the policies all alike: mean, and what 95 % of deals
    show."""
    no_success: tuple[str, ...]
    """Scenarios that no policy ever solved."""


def oracle(panel: Panel, resampling: Resampling) -> Oracle:
    """Cross-fitted and retrospective oracle over all policies of a complete panel."""
    rates = panel.rates
    means = masked_mean(rates.T)
    best = int(np.nanargmax(means))
    highest = np.where(np.isfinite(rates), rates, -1.0).max(0)
    best_rate, hindsight = resampling.rates(np.stack([rates[best], highest], 1))
    (hindsight_gain,) = resampling.differences((highest - rates[best])[:, None])
    rate = fixed = gain = _NOBODY
    if (panel.trials >= 2).all():
        chosen, always = _choose(halves(panel.successes, panel.trials, resampling.seed))
        rate, fixed = resampling.rates(np.stack([chosen, always], 1))
        (gain,) = resampling.differences((chosen - always)[:, None])
    by_chance = _hindsight_gain(permutation_null(panel.successes, panel.trials, resampling.seed))
    lost = tuple(s.id for s, total in zip(panel.scenarios, panel.successes.sum(0), strict=True) if not total)
    return Oracle(
        len(panel.scenarios), panel.arms[best], best_rate, rate, fixed, gain, hindsight, hindsight_gain,
        _range(by_chance, resampling.level), lost,
    )  # fmt: skip


def _choose(found: SplitHalves) -> tuple[np.ndarray, np.ndarray]:
    """(N,) rates of the policy chosen by scenario, and of the one chosen for all, over all divisions.

    Where several are level on a scenario, the one that is best on all of them is taken.
    """
    overall = found.choosing.mean(2)  # (S, P)
    fixed = overall.argmax(1)
    ranked = found.choosing + 1e-6 * overall[:, :, None]
    by_scenario = ranked.argmax(1)  # (S, N)
    chosen = np.take_along_axis(found.scored, by_scenario[:, None], 1)[:, 0]
    always = found.scored[np.arange(len(fixed)), fixed]
    return chosen.mean(0), always.mean(0)


def _hindsight_gain(rates: np.ndarray) -> np.ndarray:
    """(S,) highest rate of every scenario less the highest mean, of (S, P, N) rates."""
    filled = np.where(np.isfinite(rates), rates, -1.0)
    return filled.max(1).mean(1) - np.nanmean(rates, axis=2).max(1)


def _range(values: np.ndarray, level: float) -> Estimate:
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(values.mean()), float(low), float(high))


@dataclass(frozen=True)
class Profile:
    """How differently two policies do, scenario by scenario, however close their means."""

    difference: Estimate
    """Mean over scenarios of the difference, its sign taken from half of the trials and its size from the
    other: zero on average for policies that are alike. NaN with single trials."""
    hindsight: float
    """Mean absolute difference of the observed rates, which noise alone makes larger than zero."""
    floor: Estimate
    """What that is by chance alone, were the two alike: mean, and what 95 % of deals show."""
    higher: int
    """Scenarios on which a's observed rate is higher."""
    lower: int
    equal: int


def profile_difference(panel: Panel, a: int, b: int, resampling: Resampling) -> Profile:
    """Compares two policies of a panel scenario by scenario.

    Args:
        panel: the trials.
        a: index of the first.
        b: index of the second.
        resampling: of the panel's scenarios.
    """
    difference = panel.rates[a] - panel.rates[b]
    known = np.isfinite(difference)
    d = difference[known]
    estimate, floor = _NOBODY, _NOBODY
    successes, trials = panel.successes[[a, b]][:, known], panel.trials[[a, b]][:, known]
    if len(d):
        by_chance = permutation_null(successes, trials, resampling.seed)
        floor = _range(np.abs(by_chance[:, 0] - by_chance[:, 1]).mean(1), resampling.level)
    if len(d) and (trials >= 2).all():
        parts = halves(successes, trials, resampling.seed)
        sign = np.sign(parts.choosing[:, 0] - parts.choosing[:, 1])
        column = np.full(len(difference), np.nan)
        column[known] = (sign * (parts.scored[:, 0] - parts.scored[:, 1])).mean(0)
        (estimate,) = resampling.differences(column[:, None])
    return Profile(
        estimate,
        float(np.abs(d).mean()) if len(d) else _NAN,
        floor,
        int((d > 1e-12).sum()),
        int((d < -1e-12).sum()),
        int((np.abs(d) <= 1e-12).sum()),
    )


def gain_over(
    successes: np.ndarray, trials: np.ndarray, own: int, others: list[int], resampling: Resampling
) -> Estimate:
    """The best of the others minus one policy: chosen on half of the trials, scored on the other half.

    With single trials, half of the scenarios choose and the other half are scored.

    Args:
        successes: (P, N) int, on one group of scenarios.
        trials: (P, N) int.
        own: index of the policy.
        others: indices of the alternatives.
        resampling: of the N scenarios.
    """
    rows = [own, *others]
    y, k = successes[rows], trials[rows]
    count = y.shape[1]
    if not count or (k < 1).any():
        return _NOBODY
    if (k >= 2).all():
        parts = halves(y, k, resampling.seed)
        best = 1 + parts.choosing[:, 1:].mean(2).argmax(1)
        gains = parts.scored[np.arange(len(best)), best] - parts.scored[:, 0]
        column, times = gains.mean(0), 1.0
    else:
        if count < 2:
            return _NOBODY
        column, best = _by_scenarios(y / k, resampling.seed)
        times = 2.0  # scenarios that choose and are scored in turn: Nadeau and Bengio (2003), for halves
    found = resampling.spread(column)
    # Another sample of scenarios may choose another: as much as the choices of these divisions differ.
    rates = (y / k).mean(1)
    found = replace(found, variance=times * found.variance + float((rates[best] - rates[0]).var()))
    return estimate_of(found.value, difference_interval(found, resampling.level))


def _by_scenarios(rates: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) gains over row 0, each of the best row on the other half of the scenarios, over many divisions,
    and the rows that were chosen."""
    rng = np.random.default_rng(seed)
    count = rates.shape[1]
    total, scored, chosen = np.zeros(count), np.zeros(count), []
    for _ in range(SPLITS):
        first = np.zeros(count, bool)
        first[rng.permutation(count)[: count // 2]] = True
        for choosing in (first, ~first):
            best = 1 + int(rates[1:, choosing].mean(1).argmax())
            total[~choosing] += rates[best, ~choosing] - rates[0, ~choosing]
            scored[~choosing] += 1
            chosen.append(best)
    return total / scored, np.array(chosen)
