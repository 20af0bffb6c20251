"""Tables of a report about policies, each over all of its scenarios."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.robot_tables import of_robots, outcome_words
from lerobot_roborecover.analysis.stats.intervals import UNDEFINED, Estimate
from lerobot_roborecover.analysis.stats.macro import (
    MACRO_9,
    PAPER_CELLS,
    cells_of,
    macro_9_estimates,
    macro_estimates,
    percentile_macro,
)
from lerobot_roborecover.analysis.stats.resampling import masked_mean
from lerobot_roborecover.analysis.stats.soundness import valid_trials
from lerobot_roborecover.analysis.stats.units import ESTIMAND, ResamplingUnit
from lerobot_roborecover.analysis.tables import Cell, Column, Table
from lerobot_roborecover.scenario import Outcome, Start

_DEFINITIONS = 2
"""Notes of the overall table that define its numbers."""


def overall(results: Results) -> Table:
    """Initial rate, RSR, Macro, retention, RSR without invalid trials; for other tasks; and as in the
    paper."""
    panel, draws = results.recovery, results.draws
    rsr, cells = draws.rates(panel.rates.T), cells_of(panel, draws)
    macro = {MACRO_9: macro_9_estimates(panel, draws)}
    if cells.counted and not cells.is_macro_9:
        macro = {cells.title: macro_estimates(panel, draws), **macro}
    retention = results.retention
    initial = initial_estimates(results)
    valid = masked_mean(panel.valid_rates.T)
    tasks = rsr if results.tasks is None else results.tasks.rates(panel.rates.T)
    paper, paper_macro = draws.percentile(panel.rates.T), percentile_macro(panel, draws, PAPER_CELLS)
    measured = valid_trials(panel)

    def of(estimates: Sequence[Estimate], p: int) -> Estimate:
        return estimates[p] if measured[p] else UNDEFINED  # invalid trials alone say nothing about it

    rows = [
        (
            policy, initial[p], of(rsr, p), *(of(found, p) for found in macro.values()), retention[p],
            _scenarios(results, p), int(panel.trials[p].sum()), int(panel.invalid[p].sum()),
            float(valid[p]), of(tasks, p), of(paper, p), of(paper_macro, p),
        )
        for p, policy in enumerate(panel.arms)
    ]  # fmt: skip
    columns = (
        Column("Policy"), Column("Initial state %", "percent"), Column("RSR %", "percent"),
        *(Column(f"{title} %", "percent") for title in macro), Column("Retention", "ratio"),
        Column("Scenarios", "count"), Column("Trials", "count"), Column("Invalid", "count"),
        Column("RSR % without invalid", "percent"), Column("RSR %, tasks like these", "percent"),
        Column("RSR % (percentile bootstrap, as in the paper)", "percent"),
        Column(f"{MACRO_9} % (percentile bootstrap, as in the paper)", "percent"),
    )  # fmt: skip
    notes = (
        "RSR: mean of the scenarios' success rates, each scenario counting the same. Macro-k: mean "
        "of the rates of the k cells that are large enough, for policies with trials in all of them; "
        f"{MACRO_9}: of the paper's nine cells, and of no fewer. {_of_first_states(results)}"
        "Invalid trials count "
        "as failures, except under “RSR % without invalid”, where they and scenarios without a valid trial "
        "are left out.",
        f"[{100 * draws.level:g} % intervals] of rates: Agresti-Coull with the effective number of "
        f"{results.unit} ({draws.units} of them), which covers where a bootstrap does not "
        "(docs/statistics.md), and Clopper-Pearson where no trial or every trial succeeds; "
        f"they speak of {ESTIMAND[panel.unit(results.options.cluster)]}. {_of_tasks(results)}Percentile "
        f"bootstrap, as in the paper: {draws.draws} draws, seed {draws.seed}, to compare with the paper.",
        *(f"Incomplete: {arm.title}: {arm.missing.words}." for arm in results.arms if arm.missing),
        *(() if of_robots(results) else cells.notes(results.unit)),
    )
    return Table("overall", "Overall results", columns, tuple(rows), notes)


def in_short(table: Table, robots: bool = False) -> Table:
    """The overall table as a terminal shows it: up to the invalid trials, without definitions.

    Args:
        table: by `overall`.
        robots: of trials on robots, which have recovery points alone, and cells of their own.
    """
    titles = [column.title for column in table.columns]
    kept = [
        i
        for i, title in enumerate(titles[: titles.index("Invalid") + 1])
        if not (robots and title.startswith(("Initial", "Macro", "Retention")))
    ]
    columns, rows = (
        tuple(table.columns[i] for i in kept),
        [tuple(row[i] for i in kept) for row in table.rows],
    )
    return replace(table, columns=columns, rows=tuple(rows), notes=table.notes[_DEFINITIONS:])


def _scenarios(results: Results, p: int) -> str | int:
    """Scenarios that a policy was run on; with how many it was to be run on, where that is more."""
    count = int((results.recovery.trials[p] > 0).sum())
    (arm,) = (a for a in results.study.of(Start.RECOVERY) if a.title == results.recovery.arms[p])
    wanted = max((row.run_scenarios or 0 for row in arm.rows), default=0)
    return f"{count} of {wanted}" if arm.missing.scenarios and wanted > count else count


def _of_first_states(results: Results) -> str:
    panel = results.initial
    if panel is None:
        return ""
    return (
        f"Initial state: mean over the {len(panel.scenarios)} first states that the scenarios branch off "
        "from, each counting the same; they are the units of its interval. Retention: recovery over "
        "initial-state success on the same scenarios, each with its first state's rate; first states are the "
        "units. "
    )


def _of_tasks(results: Results) -> str:
    tasks = results.tasks
    if tasks is None:
        return ""
    return f"Tasks like these: the same over the {tasks.units} tasks, for {ESTIMAND[ResamplingUnit.TASK]}. "


def initial_estimates(results: Results, *, as_in_the_paper: bool = False) -> list[Estimate]:
    """Initial-state rate of every policy over all its initial trials; undefined for one without.

    Args:
        results: the study.
        as_in_the_paper: with the paper's percentile bootstrap.
    """
    panel = results.initial
    if panel is None:
        return [UNDEFINED for _ in results.recovery.arms]
    draws = results.resample(panel)
    estimates = (draws.percentile if as_in_the_paper else draws.rates)(panel.rates.T)
    found = dict(zip(panel.arms, estimates, strict=True))
    return [found.get(policy, UNDEFINED) for policy in results.recovery.arms]


def outcomes(results: Results) -> Table:
    """Trials by outcome, policy and start."""
    kinds = [o for o in Outcome if any(r.outcome == o for arm in results.study.arms for r in arm.rows)]
    rows, robots = [], of_robots(results)
    for arm in results.arms:
        counts = Counter(row.outcome for row in arm.rows)
        rows.append((arm.policy, arm.start.value, len(arm.rows), *(counts[k.value] for k in kinds)))
    columns = (
        Column("Policy"), Column("Start"), Column("Trials", "count"),
        *(Column(outcome_words(kind, robots), "count") for kind in kinds),
    )  # fmt: skip
    valid = outcome_words(Outcome.HORIZON, robots)
    notes = (f"All outcomes but success and {valid} are invalid: the policy did not have its full chance.",)
    return Table("outcomes", "How trials ended", columns, tuple(rows), notes)


def beside_published(results: Results) -> Table:
    """This study's policies beside the paper's twelve rows and LIBERO-Plus."""
    panel, draws = results.recovery, results.draws
    rsr, macro = draws.percentile(panel.rates.T), percentile_macro(panel, draws, PAPER_CELLS)
    initial = initial_estimates(results, as_in_the_paper=True)
    rated: list[tuple[Estimate, tuple[Cell, ...]]] = [
        (rsr[p], (policy, "this report", initial[p], rsr[p], macro[p], None))
        for p, policy in enumerate(panel.arms)
    ]
    remarks = []
    for row in published.policies(results.study.platform):
        plus: Cell = row.libero_plus
        if plus is None:
            plus = "not published"
        elif row.libero_plus_note:
            remarks.append(f"{row.policy} ({row.platform}): {row.libero_plus_note}")
        rated.append((row.rsr, (row.policy, "published", row.initial, row.rsr, row.macro9, plus)))
    rows = tuple(cells for _, cells in sorted(rated, key=lambda pair: -pair[0].value))
    columns = (
        Column("Policy"), Column("Origin"), Column("Initial state %", "percent"),
        Column("RSR %", "percent"), Column(f"{MACRO_9} %", "percent"), Column("LIBERO-Plus %", "percent"),
    )  # fmt: skip
    said = f" ({'; '.join(remarks)})" if remarks else ""
    notes = (
        "All intervals are percentile bootstraps, as in the paper. "
        "Published rows are the paper's, not re-run here. They are comparable with this report "
        "only where its trials "
        "are on the paper's 200 test scenarios of the platform. LIBERO-Plus: totals published by others, "
        f"another benchmark{said}.",
        *(note for note in cells_of(panel, draws).notes(results.unit) if note.startswith(MACRO_9)),
    )
    return Table("published", "Beside the published results", columns, rows, notes)
