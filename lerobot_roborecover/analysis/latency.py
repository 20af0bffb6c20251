"""RSR against latency: trials of the same policy whose inferences were given different lengths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import RowsError, rsr, scenario_rates
from lerobot_roborecover.analysis.stats.intervals import LEVEL, Estimate, estimate_of, rate_interval, spread
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Start

MEASURED = float("nan")
"""Latency of trials that were charged what each inference took."""


@dataclass(frozen=True)
class LatencyRate:
    policy: str
    during_inference: str
    """`hold` or `chunk`; empty with a frozen clock."""
    latency_s: float
    """0 with a frozen clock; NaN where it was measured."""
    scenarios: int
    trials: int
    invalid: int
    rate: Estimate
    """RSR, in [0, 1]."""


def latency_rates(rows: Iterable[TrialRow], level: float = LEVEL) -> list[LatencyRate]:
    """Rates from recovery points, by policy, what is executed during inference, and latency.

    Args:
        rows: of one log or several.
        level: of the intervals.

    Raises:
        RowsError: no such trials; or the latencies of a policy were run on different scenarios.
    """
    groups: dict[tuple[str, str, float], list[TrialRow]] = {}
    for row in rows:
        if row.start == Start.RECOVERY and not row.interventions:
            groups.setdefault(_key(row), []).append(row)
    if not groups:
        raise RowsError("no trials from recovery points: give logs of --env.start=recovery")
    found, seen = [], {}
    for key in sorted(groups, key=lambda k: (k[0], k[1], np.nan_to_num(k[2], nan=np.inf))):
        rates = scenario_rates([asdict(row) for row in groups[key]])
        before = seen.setdefault(key[0], rates.ids)
        if set(before) != set(rates.ids):
            odd = sorted(set(before) ^ set(rates.ids))
            raise RowsError(
                f"{key[0]} was run on {len(rates.ids)} scenarios at {_words(key)} and on {len(before)} at "
                f"another latency ({odd[0]} is one of {len(odd)} that differ): run all latencies on the same"
            )
        bounds = rate_interval(spread(rates.rates, rates.units), level)
        trials, invalid = int(rates.trials.sum()), int(rates.invalid.sum())
        estimate = estimate_of(rsr(rates.rates), bounds)
        found.append(LatencyRate(*key, len(rates.ids), trials, invalid, estimate))
    return found


def _key(row: TrialRow) -> tuple[str, str, float]:
    during_inference, latency = row.options.get("realtime"), row.options.get("latency_s")
    if not during_inference:
        return row.policy, "", 0.0
    return row.policy, str(during_inference), float(latency) if isinstance(latency, int | float) else MEASURED


def _words(key: tuple[str, str, float]) -> str:
    _, during_inference, latency_s = key
    if not during_inference:
        return "a frozen clock"
    return f"{'measured latency' if np.isnan(latency_s) else f'{latency_s:g} s'} ({during_inference})"


def latency_table(rates: Sequence[LatencyRate], level: float = LEVEL) -> Table:
    columns = (
        Column("Policy"), Column("Inference"), Column("Scenarios", "count"), Column("Trials", "count"),
        Column("Invalid", "count"), Column("RSR %", "percent"),
    )  # fmt: skip
    rows = tuple(
        (
            r.policy,
            _words((r.policy, r.during_inference, r.latency_s)),
            r.scenarios,
            r.trials,
            r.invalid,
            r.rate,
        )
        for r in rates
    )
    notes = (
        f"Intervals: {100 * level:g} %. During an inference, hold repeats the last action and chunk goes on "
        "with the last chunk.",
    )
    return Table("latency", "RSR against latency", columns, rows, notes)
