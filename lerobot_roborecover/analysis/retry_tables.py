"""The tables of retries: RSR@k, and success against a budget of steps, of policies and interventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.resampling import Resampling
from lerobot_roborecover.analysis.stats.retries import (
    ATTEMPTS,
    Attempts,
    attempts_of,
    rates_for_steps,
    rates_within,
)
from lerobot_roborecover.analysis.stats.soundness import valid_trials
from lerobot_roborecover.analysis.tables import Column, Table

BUDGETS = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Steps that the table shows, in horizons; as far as there are trials."""


@dataclass(frozen=True)
class Retried:
    """A policy's or an intervention's attempts, and the units of its scenarios."""

    attempts: Attempts
    draws: Resampling


def retried(results: Results) -> list[Retried]:
    """Every policy with a valid trial, best first, then every intervention; empty where no scenario has two
    trials of one."""
    of = {arm.title: arm for arm in results.study.arms}
    panels = [results.recovery, *([] if results.interventions is None else [results.interventions])]
    found: dict[str, Retried] = {}
    for panel in panels:
        draws, valid = results.resample(panel), valid_trials(panel)
        for p, title in enumerate(panel.arms):
            if title not in found and valid[p]:
                attempts = attempts_of(of[title], panel, p, results.options.scheduled)
                found[title] = Retried(attempts, draws)
    every = list(found.values())
    return every if any(one.attempts.most > 1 for one in every) else []


def retry_tables(results: Results) -> list[Table]:
    """RSR@k and success against steps; none where every scenario has one trial."""
    every = retried(results)
    if not every:
        return []
    most = max(one.attempts.most for one in every)
    attempts = [k for k in ATTEMPTS if k <= most]
    budgets = [b for b in BUDGETS if b <= most]
    within = [
        (one.attempts.title, *_estimates(one, rates_within(one.attempts, attempts), attempts))
        for one in every
    ]
    spent = [
        (one.attempts.title, *_estimates(one, rates_for_steps(one.attempts, np.array(budgets)), budgets))
        for one in every
    ]
    fewer = [one.attempts.title for one in every if one.attempts.most < attempts[-1]]
    lacking = (f"Fewer trials of some scenario: {', '.join(fewer)}.",) if fewer else ()
    return [
        Table(
            "retries",
            "Success within k attempts (RSR@k)",
            (Column("Policy"), *(Column(f"RSR@{k} %", "percent") for k in attempts)),
            tuple(within),
            (
                "RSR@k: a scenario counts as recovered when one of k attempts from its recovery point "
                "succeeds. 1 - C(n - s, k) / C(n, k) for s successes in n trials, averaged over scenarios; "
                "RSR@1 is RSR.",
                *lacking,
                *_deterministic(every),
            ),
        ),
        Table(
            "retry_budgets",
            "Success against a budget of steps, with retries",
            (Column("Policy"), *(Column(f"{b:g} × horizon", "percent") for b in budgets)),
            tuple(spent),
            (
                "Recover, roll back to the recovery point, retry: attempts follow one another until one "
                "succeeds or the budget is spent, their new steps summed; mean over all orders of a "
                "scenario's trials. A rollback itself takes no step. Budgets are multiples of a scenario's "
                "horizon.",
                *lacking,
            ),
        ),
    ]


def _estimates(one: Retried, rates: np.ndarray, attempts: Sequence[float]) -> list[Estimate]:
    """Means of (N, K) columns with their intervals; up to one attempt they are those of any rate."""
    single = sum(k <= 1 for k in attempts)
    return [*one.draws.rates(rates[:, :single]), *one.draws.rates_of_retries(rates[:, single:])]


def _deterministic(every: list[Retried]) -> tuple[str, ...]:
    names = [one.attempts.title for one in every if one.attempts.deterministic]
    if not names:
        return ()
    return (
        f"Deterministic, because all trials of each scenario came out alike: {', '.join(names)}. A retry of "
        "a deterministic policy brings nothing, and its RSR@k are equal.",
    )
