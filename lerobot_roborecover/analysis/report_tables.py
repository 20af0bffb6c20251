"""The tables of a report, each from one estimator."""

from __future__ import annotations

import math
from collections import Counter

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.gain_tables import gain_tables, inversions, task_gains
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.runs_tables import runs_tables
from lerobot_roborecover.analysis.stats.crossfit import oracle, profile_difference
from lerobot_roborecover.analysis.stats.groups import Group, group_rates, source_matrix
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.macro import (
    MACRO_9,
    PAPER_CELLS,
    cells_of,
    macro_9_estimates,
    macro_estimates,
    percentile_macro,
)
from lerobot_roborecover.analysis.stats.ranking import rank_agreement
from lerobot_roborecover.analysis.stats.resampling import masked_mean
from lerobot_roborecover.analysis.stats.timing import FRACTIONS, budget_estimates, median_steps
from lerobot_roborecover.analysis.stats.trial_metrics import trial_metrics
from lerobot_roborecover.analysis.stats.units import ESTIMAND, ResamplingUnit
from lerobot_roborecover.analysis.stats.variance import variance_split
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING, ComparisonVerdict
from lerobot_roborecover.analysis.tables import Cell, Column, Table
from lerobot_roborecover.scenario import Outcome, Start

_NAN = float("nan")
_NOBODY = Estimate(_NAN, _NAN, _NAN)
_VERDICTS = {v: v.value for v in ComparisonVerdict} | {
    ComparisonVerdict.A_BETTER: "helps",
    ComparisonVerdict.B_BETTER: "harms",
}
"""Of an intervention against direct control."""


def all_tables(results: Results) -> list[Table]:
    """Every table that the study has something for, in the order of the report."""
    tables = [overall(results), outcomes(results)]
    if results.several_runs:
        tables += runs_tables(results)
    if len(results.recovery.arms) > 1:
        tables.append(paired_contrasts(results))
        tables.append(profiles(results))
    if len(results.matched) > 1:
        tables.append(ranks(results))
        tables += [table for table in [inversions(results)] if table.rows]
    tables += [grouped(results, *axis) for axis in _AXES]
    if any(row.scenarios for row in source_matrix(results.recovery, results.draws)):
        tables.append(sources_by_policy(results))
    if len(results.recovery.arms) > 1:
        tables.append(oracle_table(results))
    tables += [
        budgets(results), trial_metrics(results.recovery, results.draws), variance(results)
    ]  # fmt: skip
    if results.costs:
        tables += [interventions(results), *gain_tables(results)]
    if published.policies(results.study.platform):
        tables.append(beside_published(results))
    return tables


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
    rows = [
        (
            policy, initial[p], rsr[p], *(found[p] for found in macro.values()), retention[p],
            _scenarios(results, p), int(panel.trials[p].sum()), int(panel.invalid[p].sum()),
            float(valid[p]), tasks[p], paper[p], paper_macro[p],
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
        f"{results.unit} ({draws.units} of them), which covers where a bootstrap does not (docs/report.md), "
        "and Clopper-Pearson where no trial or every trial succeeds; "
        f"they speak of {ESTIMAND[panel.unit(results.options.cluster)]}. {_of_tasks(results)}Percentile "
        f"bootstrap, as in the paper: {draws.draws} draws, seed {draws.seed}, to compare with the paper.",
        *(f"Incomplete: {arm.title}: {arm.missing.words}." for arm in results.arms if arm.missing),
        *cells.notes(results.unit),
    )
    return Table("overall", "Overall results", columns, tuple(rows), notes)


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
        return [_NOBODY for _ in results.recovery.arms]
    draws = results.resample(panel)
    estimates = (draws.percentile if as_in_the_paper else draws.rates)(panel.rates.T)
    found = dict(zip(panel.arms, estimates, strict=True))
    return [found.get(policy, _NOBODY) for policy in results.recovery.arms]


def outcomes(results: Results) -> Table:
    """Trials by outcome, policy and start."""
    kinds = [o for o in Outcome if any(r.outcome == o for arm in results.study.arms for r in arm.rows)]
    rows = []
    for arm in results.arms:
        counts = Counter(row.outcome for row in arm.rows)
        rows.append((arm.policy, arm.start.value, len(arm.rows), *(counts[k.value] for k in kinds)))
    columns = (
        Column("Policy"), Column("Start"), Column("Trials", "count"),
        *(Column(kind.value.replace("_", " "), "count") for kind in kinds),
    )  # fmt: skip
    notes = ("All outcomes but success and horizon are invalid: the policy did not have its full chance.",)
    return Table("outcomes", "How trials ended", columns, tuple(rows), notes)


def paired_contrasts(results: Results) -> Table:
    """All pairs: difference from both starts, adjusted p, verdict."""
    tasks = _task_differences(results)
    rows = [
        (
            c.a, c.b, i.difference, c.difference, c.p, c.p_holm, c.verdict.value, c.scenarios, c.differing,
            t,
        )
        for c, i, t in zip(results.contrasts, results.initial_contrasts, tasks, strict=True)
    ]  # fmt: skip
    columns = (
        Column("A"), Column("B"), Column("Initial state, A − B", "points"), Column("RSR, A − B", "points"),
        Column("p", "p"), Column("p (Holm)", "p"), Column("Verdict"), Column("Scenarios", "count"),
        Column("Differing", "count"),
        Column("RSR, A − B, tasks like these", "points"),
    )  # fmt: skip
    family = max((c.family for c in results.contrasts), default=0)
    level = results.options.level
    notes = (
        "Percentage points, over the scenarios that both were run on. Intervals are not adjusted; p (Holm) "
        f"is, for the {family} pairs of complete policies. p: paired sign-flip permutation test over "
        f"{results.unit}. It tests whether their differences are as likely to have either sign, not whether "
        "their mean is zero: a policy that is much better on few and a little worse on many can be told "
        "apart from one with the same RSR.",
        f"Verdict: p (Holm) below {1 - level:.3g}, and at least {LEAST_DIFFERING} {results.unit} on which "
        "the two differ; incomplete policies have none.",
        *_watched_note(results),
    )
    return Table("contrasts", "Paired differences", columns, tuple(rows), notes)


def _watched_note(results: Results) -> list[str]:
    """Which pairs have the sequential test."""
    pairs = [f"{c.a}, {c.b}" for c in results.contrasts if c.sequential]
    if not pairs:
        return []
    return [
        f"Watched while they ran, with p and interval of the sequential test ({'; '.join(pairs)}): they hold "
        "at every look, on the scenarios whose turn had come."
    ]


def _task_differences(results: Results) -> list[Estimate]:
    """The contrasts' differences with intervals over tasks."""
    panel = results.recovery
    found = []
    for c in results.contrasts:
        own = results.ranked if {c.a, c.b} <= set(results.ranked.arms) else panel
        draws = results.resample(own, ResamplingUnit.TASK)
        values = own.rates[own.arm(c.a)] - own.rates[own.arm(c.b)]
        found += draws.differences(values[:, None])
    return found


def profiles(results: Results) -> Table:
    """Profile difference of every pair: cross-fitted, in hindsight, and by chance alone."""
    panel, draws = results.recovery, results.draws
    rows = []
    for a, b in results.shown_pairs:
        w = profile_difference(panel, a, b, draws)
        rows.append(
            (panel.arms[a], panel.arms[b], w.difference, w.hindsight, w.floor, w.higher, w.lower, w.equal)
        )
    columns = (
        Column("A"), Column("B"), Column("Profile difference, cross-fitted", "points"),
        Column("as observed", "points"), Column("by chance alone", "points"), Column("A higher", "count"),
        Column("B higher", "count"), Column("Equal", "count"),
    )  # fmt: skip
    notes = (
        "How differently two policies do scenario by scenario, whatever their RSR. Cross-fitted: the sign of "
        "each scenario's difference from half of its trials, the size from the other half; zero on average "
        "for policies that are alike. As observed: mean absolute difference, which noise makes larger than "
        "zero. By chance alone: what that would be were the two alike (mean, and what 95 % of random deals "
        "of the trials show).",
        *(
            (f"Only {panel.arms[0]} against every other policy, of {len(results.contrasts)} pairs.",)
            if len(rows) < len(results.contrasts)
            else ()
        ),
    )
    return Table("profiles", "Profile differences", columns, tuple(rows), notes)


def ranks(results: Results) -> Table:
    """Agreement of the orders from initial states and from recovery points."""
    found = rank_agreement(*results.both_starts)
    inverted = "; ".join(f"{a} over {b}" for a, b in found.inverted) or "none"
    rows: list[tuple[Cell, ...]] = [
        ("Rank inversions", found.inversions), ("Spearman's rho", found.rho), ("Kendall's tau", found.tau)
    ]  # fmt: skip
    pairs = found.policies * (found.policies - 1) // 2
    notes = (
        f"{found.policies} policies. Order from initial states that recovery inverts: {inverted}. Of {pairs} "
        f"pairs, {found.shown_inverted} are separated from both starts and the other way round, "
        f"{found.shown_same} the same way round; the bounds let all others be either.",
    )
    return Table(
        "ranks",
        "Initial-state order against recovery order",
        (Column("Measure"), Column("Value", "ratio")),
        tuple(rows),
        notes,
    )


_AXES = (
    ("cell", "cells", "RSR by cell (stage and deviation type)", "Cell"),
    ("source", "sources", "RSR by construction source", "Source"),
    ("suite", "suites", "RSR by task suite", "Suite"),
)


def grouped(results: Results, label: str, name: str, title: str, heading: str) -> Table:
    """RSR % by one label of the scenarios."""
    panel = results.recovery
    groups = group_rates(panel, label, results.draws)
    rows = [(_group_name(g, label), g.scenarios, *g.estimates) for g in groups]
    columns = (Column(heading), Column("N", "count"), *(Column(p, "percent") for p in panel.arms))
    sparse = frozenset(i for i, g in enumerate(groups) if g.underpowered)
    return Table(
        name,
        title,
        columns,
        tuple(rows),
        ("RSR in %, N scenarios; intervals are over the group's own scenarios.",),
        sparse,
    )


def _group_name(group: Group, label: str) -> str:
    return group.label.replace("-", ", ", 1) if label == "cell" else group.label


def sources_by_policy(results: Results) -> Table:
    """Source × recovery matrix with the observed-best alternative's gain."""
    panel = results.recovery
    found = source_matrix(panel, results.draws)
    rows = []
    for row in found:
        best = panel.arms[row.best_other] if row.best_other is not None else "none"
        rows.append(
            (row.source_policy, row.scenarios, *row.rates, best, row.gain or _NOBODY, row.hindsight_gain)
        )
    columns = (
        Column("Source policy"), Column("N", "count"), *(Column(p, "percent") for p in panel.arms),
        Column("Observed best other"), Column("Gain, cross-fitted", "points"),
        Column("Gain in hindsight", "points"),
    )  # fmt: skip
    notes = (
        "Natural scenarios, by the policy whose rollout led to them. Gain: best other policy minus the "
        "source policy itself. Cross-fitted: the best is chosen on half of the trials (half of the "
        "scenarios, where trials are single) and scored on the other half. In hindsight: the observed best, "
        "chosen and scored on the same trials, and so too high.",
    )
    sparse = frozenset(i for i, row in enumerate(found) if row.underpowered)
    return Table("source_matrix", "Source policy × recovery policy", columns, tuple(rows), notes, sparse)


def oracle_table(results: Results) -> Table:
    """Oracle: cross-fitted, in hindsight, and by chance alone."""
    found = oracle(results.ranked, results.ranked_draws)
    rows = (
        ("Best policy of each scenario, chosen on half of the trials, scored on the other", found.rate),
        ("Best policy of all, chosen and scored the same way", found.fixed),
        ("Difference", found.gain),
        ("Best observed policy of each scenario, in hindsight", found.hindsight),
        (f"Best policy of all ({found.best_policy})", found.best_rate),
        ("Difference in hindsight", found.hindsight_gain),
        ("Difference in hindsight by chance alone", found.floor),
    )
    lost = ", ".join(found.no_success[:5]) + (", ..." if len(found.no_success) > 5 else "")
    notes = (
        "In hindsight the best is chosen and scored on the same trials, which is too high, and no method "
        "that could be deployed. By chance alone: what it would be were the policies alike (mean, and what "
        "95 % of random deals of the trials show). Choosing on half takes two trials of each scenario. No "
        f"policy ever solved {len(found.no_success)} of {found.scenarios} "
        f"scenarios{f' ({lost})' if lost else ''}.",
    )
    return Table("oracle", "Oracle", (Column("What"), Column("RSR %", "percent")), rows, notes)


def budgets(results: Results) -> Table:
    """RSR at smaller step budgets, and the median time to recover."""
    panel = results.recovery
    found = budget_estimates(panel, FRACTIONS, results.draws)
    rows = [
        (policy, *found[p], steps)
        for p, (policy, steps) in enumerate(zip(panel.arms, median_steps(panel), strict=True))
    ]
    columns = (
        Column("Policy"), *(Column(f"{100 * f:g} % of the horizon", "percent") for f in FRACTIONS),
        Column("Median steps to success", "number"),
    )  # fmt: skip
    notes = ("RSR in % had each trial been stopped at that share of its scenario's horizon.",)
    return Table("budgets", "RSR at smaller step budgets", columns, tuple(rows), notes)


def variance(results: Results) -> Table:
    """Between and within scenarios, and what more of either would buy."""
    panel = results.recovery
    rows = []
    for p, policy in enumerate(panel.arms):
        v = variance_split(panel.successes[p], panel.trials[p])
        spread = [math.sqrt(x) if x >= 0 else _NAN for x in (v.between, v.within)]
        rows.append(
            (
                policy,
                v.trials,
                *spread,
                v.standard_error,
                v.one_more_trial,
                v.same_cost_scenarios,
                v.one_more_scenario,
            )
        )
    columns = (
        Column("Policy"), Column("Trials per scenario", "number"), Column("SD between scenarios", "points"),
        Column("SD within a scenario", "points"), Column("Standard error of RSR", "points"),
        Column("with 1 more trial each", "points"), Column("the same trials on new scenarios", "points"),
        Column("with 1 more scenario", "points"),
    )  # fmt: skip
    notes = (
        "Points. Standard errors take the scenarios as drawn at random from many such; they ignore "
        "clusters. The two "
        "middle ones cost the same number of trials.",
    )
    return Table("variance", "What the uncertainty is made of", columns, tuple(rows), notes)


def interventions(results: Results) -> Table:
    """Gain, cost and harm of interventions."""
    kinds = sorted({kind for cost in results.costs for kind in cost.per_trial})
    rows = [
        (
            c.arm, c.baseline, c.scenarios, c.direct, c.with_intervention, c.gain, d.p, d.p_holm,
            _VERDICTS[d.verdict], t.difference, t.p_holm, c.extra_steps, c.triggered,
            *(c.per_trial.get(kind, 0.0) for kind in kinds), c.matched, c.rescued, c.harmed,
        )
        for c, d, t in zip(results.costs, results.procedure_contrasts, task_gains(results), strict=True)
    ]  # fmt: skip
    columns = (
        Column("Intervention"), Column("Direct control"), Column("Scenarios", "count"),
        Column("Direct RSR %", "percent"), Column("RSR %", "percent"), Column("Gain", "points"),
        Column("p", "p"), Column("p (Holm)", "p"), Column("Verdict"),
        Column("Gain, tasks like these", "points"), Column("p (Holm), tasks", "p"),
        Column("Extra steps per trial", "number"), Column("Triggered %", "percent"),
        *(Column(f"{kind} per trial", "ratio") for kind in kinds),
        Column("Matched trials", "count"), Column("Rescued", "count"), Column("Harmed", "count"),
    )  # fmt: skip
    notes = (
        "Not entries of the policy comparison: an intervention changes the starting state or adds "
        "a controller. "
        "Matched trials share scenario and trial index. Rescued: direct control fails, the "
        "intervention solves. "
        "Harmed: direct control solves, the intervention loses. p (Holm): for the interventions of this "
        "table, each against its direct control. Tasks like these: the same over tasks, for "
        f"{ESTIMAND[ResamplingUnit.TASK]}; Holm for the same family. p: sign flips, which test whether "
        "differences are as likely to have either sign, not whether their mean is zero.",
    )
    return Table("interventions", "Interventions against direct control", columns, tuple(rows), notes)


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
