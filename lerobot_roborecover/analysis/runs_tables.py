"""The tables of methods with several runs."""

from __future__ import annotations

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.verdicts import LEAST_RUNS
from lerobot_roborecover.analysis.tables import Cell, Column, Table


def runs_tables(results: Results) -> list[Table]:
    """Methods, their runs, and what may be said of pairs of methods."""
    tables = [methods(results), each_run(results)]
    if len(results.recovery.arms) > 1:
        tables.append(method_differences(results))
    return tables


def methods(results: Results) -> Table:
    """One row a method: these runs, other runs like these, and how far the runs lie apart."""
    draws = results.draws
    these = draws.rates(results.recovery.rates.T)
    rows = [
        (
            m.method, len(m.each), rate, m.other_runs, m.bootstrap, m.sd, m.noise, m.lowest, m.highest,
        )
        for m, rate in zip(results.method_rates, these, strict=True)
    ]  # fmt: skip
    columns = (
        Column("Method"), Column("Runs", "count"), Column("RSR %, these runs", "percent"),
        Column("RSR %, runs like these", "percent"),
        Column("RSR % (hierarchical bootstrap, percentile)", "percent"),
        Column("SD between runs", "points"), Column("of that by trials alone", "points"),
        Column("Lowest %", "percent"), Column("Highest %", "percent"),
    )  # fmt: skip
    notes = (
        f"These runs: the mean over runs, with the interval over {results.unit}: it speaks of the policies "
        "at hand. Runs like these: with the variance between runs and that between "
        f"{results.unit}, Student's t with few degrees of freedom where runs are few: it speaks of the "
        "method. Hierarchical bootstrap: runs, units, scenarios and trials drawn anew; with few runs it "
        "covers less than it says (docs/statistics.md).",
        "By trials alone: the SD that the runs would show were they one and the same policy.",
    )
    return Table("methods", "Methods of several runs", columns, tuple(rows), notes)


def each_run(results: Results) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for found, m in zip(results.runs, results.method_rates, strict=True):
        for run, rate, trials in zip(found.runs, m.each, found.trials, strict=True):
            rows.append((found.method, run, rate, int((trials > 0).sum()), int(trials.sum())))
    columns = (
        Column("Method"), Column("Run"), Column("RSR %", "percent"), Column("Scenarios", "count"),
        Column("Trials", "count"),
    )  # fmt: skip
    notes = (f"Of one run each, over {results.unit}; a run is called like its log, or like its folder.",)
    return Table("runs", "Every run", columns, tuple(rows), notes)


def method_differences(results: Results) -> Table:
    """All pairs, of these runs and of the methods behind them."""
    rows = [
        (
            m.these_runs.a, m.these_runs.b, m.runs[0], m.runs[1], m.these_runs.difference,
            m.these_runs.verdict.value, m.difference, m.p, m.p_holm, m.verdict.value,
        )
        for m in results.method_contrasts
    ]  # fmt: skip
    columns = (
        Column("A"), Column("B"), Column("Runs of A", "count"), Column("Runs of B", "count"),
        Column("RSR, A − B, these runs", "points"), Column("Verdict on these runs"),
        Column("RSR, A − B, runs like these", "points"), Column("p", "p"), Column("p (Holm)", "p"),
        Column("Verdict on the methods"),
    )  # fmt: skip
    notes = (
        "These runs: paired differences of the rates averaged over runs, by the sign-flip test; the units "
        f"are {results.unit}, and another training of either method may do otherwise. Runs like these: with "
        "the variance between runs.",
        f"Verdict on the methods: that on these runs, at least {LEAST_RUNS} runs of each, and p (Holm) of "
        f"the interval for other runs below {1 - results.options.level:.3g}. With fewer runs no test could "
        "tell methods from runs, and there is none.",
    )
    return Table("method_contrasts", "Differences of methods", columns, tuple(rows), notes)
