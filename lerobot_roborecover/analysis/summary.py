"""The table of a run: initial rate, RSR and Macro with their intervals, invalid trials, and every cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import (
    UNDERPOWERED_BELOW,
    RowsError,
    ScenarioRates,
    initial_rate_units,
    invalid_counts,
    scenario_rates,
)
from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    RARE,
    UNDEFINED,
    Estimate,
    estimate_of,
    rate_interval,
    spread,
)
from lerobot_roborecover.analysis.stats.macro import MACRO_9, MacroCells, macro_cells, macro_of_scenarios
from lerobot_roborecover.analysis.stats.retries import ATTEMPTS, share_within
from lerobot_roborecover.analysis.stats.units import WORDS, default_unit
from lerobot_roborecover.scenario import DeviationType, Outcome, Stage, Start

_TITLES = {
    Start.INITIAL: "Initial-state success",
    Start.RECOVERY: "Recovery success (RSR)",
    Start.REVERSION: "Reversion success",
}


@dataclass(frozen=True)
class CellSummary:
    """One cell, stage × deviation type, from recovery starts."""

    cell: str
    scenarios: int
    trials: int
    estimate: Estimate

    @property
    def underpowered(self) -> bool:
        """Too few scenarios for the rate to mean much."""
        return self.scenarios < UNDERPOWERED_BELOW


@dataclass(frozen=True)
class StartSummary:
    start: Start
    scenarios: int
    trials: int
    rsr: Estimate
    """RSR of initial-state trials: first states weigh the same, and are the units of the interval."""
    macro: Estimate
    """Over the cells that are large enough; undefined where none is."""
    macro9: Estimate
    """Over the paper's nine cells; undefined where one is empty."""
    macro_cells: MacroCells
    unit: str
    """What intervals take as independent, in the plural."""
    invalid: Mapping[str, int]
    """Trials by invalid outcome; they count as failures in the rates."""
    without_infrastructure: Estimate | None
    """RSR without the trials that a simulator or a machine ended; None where there are none."""
    cells: tuple[CellSummary, ...]
    """Occupied cells, in the order of the paper's stages and types."""
    first_states: int
    """First states of the scenarios."""
    within: Mapping[int, Estimate]
    """RSR@k by k from 2, as far as every scenario has k trials; empty of initial-state trials."""

    @property
    def measured(self) -> bool:
        """Whether any trial was valid: invalid trials alone say nothing about the policy."""
        return sum(self.invalid.values()) < self.trials

    @property
    def rate(self) -> Estimate:
        """`rsr`, undefined where no trial was valid."""
        return self.rsr if self.measured else UNDEFINED


@dataclass(frozen=True)
class Summary:
    """One policy's trials, by start."""

    policy: str
    starts: Mapping[Start, StartSummary]


def summarise(rows: Sequence[Mapping[str, Any]], scheduled: int | None = None) -> Summary:
    """Summarises the trials of one policy.

    Args:
        rows: trial rows; starts may be mixed, policies may not.
        scheduled: trials each scenario was to have from each start; missing ones count as failures.

    Raises:
        RowsError: the rows are of several policies, or cannot be distinguished.
    """
    policies = sorted({str(row["policy"]) for row in rows})
    if len(policies) > 1:
        raise RowsError(
            f"the rows are of {len(policies)} policies ({', '.join(policies)}); summarise each alone"
        )
    by_start = {start: [r for r in rows if r["start"] == start] for start in Start}
    return Summary(
        policy=policies[0] if policies else "",
        starts={s: _of_start(s, group, scheduled) for s, group in by_start.items() if group},
    )


def _of_start(start: Start, rows: list[Mapping[str, Any]], scheduled: int | None) -> StartSummary:
    scenarios = scenario_rates(rows, scheduled)
    cells = sorted(set(scenarios.cells), key=_cell_order)
    macro, macro9 = macro_of_scenarios(scenarios.rates, scenarios.units, scenarios.cells)
    return StartSummary(
        start=start,
        scenarios=len(scenarios),
        trials=int(scenarios.trials.sum()),
        rsr=_rate_of(start, scenarios),
        macro=macro,
        macro9=macro9,
        macro_cells=macro_cells(scenarios.cells, scenarios.units),
        unit=WORDS[default_unit(str(rows[0].get("platform", "")))],
        invalid=invalid_counts(rows),
        without_infrastructure=_without_infrastructure(start, rows),
        cells=tuple(_of_cell(cell, scenarios.where(c == cell for c in scenarios.cells)) for cell in cells),
        first_states=len(set(scenarios.first_states)),
        within={} if start is Start.INITIAL else _within(scenarios),
    )


def _within(scenarios: ScenarioRates) -> dict[int, Estimate]:
    most = int(scenarios.trials.min())
    successes = np.rint(scenarios.rates * scenarios.trials).astype(int)
    return {
        k: rate_estimate(share_within(successes, scenarios.trials, k), scenarios.units, rare=RARE)
        for k in ATTEMPTS
        if 1 < k <= most
    }


def _rate_of(start: Start, scenarios: ScenarioRates) -> Estimate:
    if start is Start.INITIAL:
        return rate_estimate(*initial_rate_units(scenarios))
    return rate_estimate(scenarios.rates, scenarios.units)


def _without_infrastructure(start: Start, rows: Sequence[Mapping[str, Any]]) -> Estimate | None:
    left = [r for r in rows if not Outcome(r["outcome"]).infrastructure]
    if len(left) == len(rows) or not left:
        return None
    return _rate_of(start, scenario_rates(left))


def _of_cell(cell: str, scenarios: ScenarioRates) -> CellSummary:
    estimate = rate_estimate(scenarios.rates, scenarios.units)
    return CellSummary(cell, len(scenarios), int(scenarios.trials.sum()), estimate)


def rate_estimate(
    rates: np.ndarray, units: Sequence[str], level: float = LEVEL, rare: float = 0.0
) -> Estimate:
    """RSR with the interval that every table and page shows.

    Args:
        rates: (n,) in [0, 1].
        units: n labels of what is independent.
        level: confidence level.
        rare: of RSR@k, see `rate_interval`.
    """
    found = spread(rates, units)
    return estimate_of(found.value, rate_interval(found, level, rare))


def _cell_order(cell: str) -> tuple[int, int]:
    stage, deviation = cell.split("-", 1)
    return list(Stage).index(Stage(stage)), list(DeviationType).index(DeviationType(deviation))


def format_table(summary: Summary) -> str:
    """The summary as text, rates in per cent with 95 % intervals."""
    lines = [f"Policy {summary.policy}" if summary.policy else "No trials", ""]
    header = f"{'':<26}{'%':>7}  {'95 % interval':<15}{'scenarios':>10}{'trials':>8}{'invalid':>9}"
    if summary.starts:
        lines.append(header)
    for start, title in _TITLES.items():
        part = summary.starts.get(start)
        if part is None:
            continue
        counts = f"{part.scenarios:>10}{part.trials:>8}{sum(part.invalid.values()):>9}"
        lines.append(f"{title:<26}{_rate(part.rate)}{counts}")
        if not part.measured:
            continue
        lines += [f"{f'  within {k} attempts':<26}{_rate(found)}" for k, found in part.within.items()]
        if start is not Start.INITIAL:
            cells = part.macro_cells
            if cells.counted and not cells.is_macro_9:
                lines.append(f"{cells.title:<26}{_rate(part.macro)}")
            lines.append(f"{MACRO_9:<26}{_rate(part.macro9)}")
    recovery = summary.starts.get(Start.RECOVERY)
    if recovery is not None and recovery.measured:
        lines += ["", "Recovery by cell"]
        for cell in recovery.cells:
            name = f"{cell.cell} *" if cell.underpowered else cell.cell
            lines.append(f"{name:<26}{_rate(cell.estimate)}{cell.scenarios:>10}{cell.trials:>8}")
        if any(cell.underpowered for cell in recovery.cells):
            lines.append(f"* fewer than {UNDERPOWERED_BELOW} scenarios: neither rate nor interval says much")
        lines += recovery.macro_cells.notes(recovery.unit)
    initial = summary.starts.get(Start.INITIAL)
    if initial is not None and initial.first_states < initial.scenarios:
        lines.append(
            f"\nThe {initial.scenarios} scenarios branch off from {initial.first_states} first states: these "
            "are what the initial-state rate is over"
        )
    for start, part in summary.starts.items():
        if part.invalid:
            reasons = ", ".join(f"{count} {name}" for name, count in part.invalid.items())
            if not part.measured:
                lines.append(f"\nNo rate from {start.value} starts: every trial was invalid: {reasons}")
                continue
            lines.append(f"\nInvalid trials from {start.value} starts, counted as failures: {reasons}")
        if part.without_infrastructure is not None:
            rate = _rate(part.without_infrastructure).strip()
            lines.append(f"Without those that infrastructure ended: {rate}")
    return "\n".join(line.rstrip() for line in lines)


def _rate(estimate: Estimate) -> str:
    bounds = (
        f"[{100 * estimate.low:.1f}, {100 * estimate.high:.1f}]" if estimate.low == estimate.low else "n/a"
    )
    value = f"{100 * estimate.value:.1f}" if estimate.value == estimate.value else "n/a"
    return f"{value:>7}  {bounds if value != 'n/a' else '':<15}"
