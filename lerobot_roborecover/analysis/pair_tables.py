"""Tables of a report about pairs of policies."""

from __future__ import annotations

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.crossfit import profile_difference
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.ranking import rank_agreement
from lerobot_roborecover.analysis.stats.units import ResamplingUnit
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING
from lerobot_roborecover.analysis.tables import Cell, Column, Table


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
        "their mean is zero: a policy that is much better on few and a little worse on many can differ "
        "from one with the same RSR.",
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
