"""Tables that show what a headline rests on: gains by group, over tasks, and inversions pair by pair."""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW
from lerobot_roborecover.analysis.stats.gains import gains_by_group, groups_by_controller
from lerobot_roborecover.analysis.stats.intervals import UNDEFINED
from lerobot_roborecover.analysis.stats.ranking import pairs_from_both_starts
from lerobot_roborecover.analysis.stats.units import ESTIMAND, ResamplingUnit
from lerobot_roborecover.analysis.tables import Cell, Column, Table

_NAN = float("nan")


def gain_tables(results: Results) -> list[Table]:
    """Returns the tables of gains by construction source and by controller."""
    panel = results.interventions
    if panel is None:
        return []
    by_source, by_controller = panel.labels("source"), groups_by_controller(panel)
    found = [_by_group(results, "gains_by_source", "Gains by construction source", "Source", by_source)]
    if len(set(by_controller.tolist())) > len(set(by_source.tolist())):
        title = "Gains by controller"
        found.append(_by_group(results, "gains_by_controller", title, "Source, controller", by_controller))
    return found


def _by_group(results: Results, name: str, title: str, heading: str, groups: np.ndarray) -> Table:
    panel = results.interventions
    assert panel is not None, "there are interventions"
    found = gains_by_group(panel, results.intervention_pairs, groups, results.resample(panel))
    rows: list[tuple[Cell, ...]] = []
    for gain in found:
        inside, others = gain.inside, gain.outside
        row = (inside.a, gain.group, inside.scenarios, inside.difference, inside.p_holm)
        rest = (0, UNDEFINED, _NAN)
        if others is not None:
            rest = (others.scenarios, others.difference, others.p_holm)
        rows.append((*row, *rest))
    columns = (
        Column("Intervention"), Column(heading), Column("N", "count"), Column("Gain", "points"),
        Column("p (Holm)", "p"), Column("Other scenarios", "count"), Column("Gain on the others", "points"),
        Column("p (Holm) on the others", "p"),
    )  # fmt: skip
    notes = (
        "Percentage points more than direct control on the same scenarios. A gain that is gone on the other "
        "scenarios rests on this group alone. p (Holm): paired sign flips, for the interventions on these "
        "scenarios; groups are described and are not adjusted for.",
    )
    sparse = frozenset(i for i, g in enumerate(found) if g.inside.scenarios < UNDERPOWERED_BELOW)
    return Table(name, title, columns, tuple(rows), notes, sparse)


def task_gains(results: Results) -> list[Contrast]:
    """Returns the contrasts of `procedure_contrasts` over tasks, a family of their own."""
    panel = results.interventions
    if panel is None:
        return []
    turned = [(arm, base) for base, arm in results.intervention_pairs]
    return contrasts(panel.rates, panel.arms, results.resample(panel, ResamplingUnit.TASK), turned)


def inversions(results: Results) -> Table:
    """Returns every pair whose order from initial states is the other way round at recovery, with tests over
    this report's units and over tasks."""
    own = pairs_from_both_starts(*results.both_starts_over(None))
    tasks = pairs_from_both_starts(*results.both_starts_over(ResamplingUnit.TASK))
    rows: list[tuple[Cell, ...]] = []
    for pair, over in zip(own, tasks, strict=True):
        if not pair.inverted:
            continue
        ahead = pair.initial.difference.value > 0
        first, second, first_over, second_over = (
            c if ahead else c.reversed() for c in (pair.initial, pair.recovery, over.initial, over.recovery)
        )
        rows.append(
            (
                first.a, first.b, first.difference, first.p_holm, second.difference, second.p_holm,
                "yes" if pair.shown < 0 else "no", first_over.difference, first_over.p_holm,
                second_over.difference, second_over.p_holm, "yes" if over.shown < 0 else "no",
            )
        )  # fmt: skip
    columns = (
        Column("A, ahead initially"), Column("B, ahead at recovery"),
        Column("Initial state, A − B", "points"), Column("p (Holm)", "p"),
        Column("RSR, A − B", "points"), Column("p (Holm), RSR", "p"), Column("Shown"),
        Column("Initial state, tasks like these", "points"), Column("p (Holm), tasks", "p"),
        Column("RSR, tasks like these", "points"), Column("p (Holm), RSR, tasks", "p"),
        Column("Shown, tasks like these"),
    )  # fmt: skip
    error = (1 - results.options.level) / 2
    notes = (
        f"Shown: p (Holm) below {error:.3g} from both starts, each adjusted for all pairs. Initial-state "
        f"trials are tested over first states, recovery trials over {results.unit}; tasks like these: both "
        f"over tasks, for {ESTIMAND[ResamplingUnit.TASK]}.",
    )
    return Table("inversions", "Inverted pairs", columns, tuple(rows), notes)
