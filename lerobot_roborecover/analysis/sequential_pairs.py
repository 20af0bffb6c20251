"""Pairs of policies whose comparison may have been looked at while it ran: the test of `sequential.py`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from lerobot_roborecover.analysis.sequential_plan import SequentialPlan
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.contrasts import Contrast
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.sequential import SequentialTest, grid_of, sequence, whole_units
from lerobot_roborecover.analysis.stats.units import WORDS
from lerobot_roborecover.logs.sequential_record import SequentialRecord


def watched_pair(
    panel: Panel,
    pair: tuple[int, int],
    level: float,
    plan: SequentialPlan,
    planned_level: float | None = None,
) -> Contrast:
    """The sequential contrast of two policies, on the scenarios whose turn has come.

    Args:
        panel: their trials.
        pair: indices of arms; the first minus the second.
        level: confidence level at which a verdict is wanted.
        plan: what the comparison was to be over, fixed before the first look.
        planned_level: level at which it was to stop; by default `level`.
    """
    a, b = pair
    place = {s.id: n for n, s in enumerate(panel.scenarios)}
    members = plan.members
    counts = panel.trials[[a, b]]
    needed = np.maximum(plan.trials, 1)
    there = {i for i in plan.units if i in place and (counts[:, place[i]] >= needed).all()}
    grid = grid_of(plan.trials if min(plan.trials) > 0 else counts[counts > 0].tolist())
    test = SequentialTest(len(members), grid, level if planned_level is None else planned_level)
    for unit in whole_units(sequence(members), members, there):
        index = [place[i] for i in members[unit]]
        test.add(float((panel.rates[a, index] - panel.rates[b, index]).sum()), len(index))
    return Contrast(
        panel.arms[a],
        panel.arms[b],
        test.difference,
        test.p if test.steps else math.nan,
        math.nan,
        test.scenarios,
        len(test.steps),
        test.differing,
        0,
        bool(test.steps),
        level,
        WORDS[panel.unit()],
        sequential=True,
    )


def recorded_pairs(
    records: Sequence[SequentialRecord], arms: Sequence[Arm]
) -> Mapping[tuple[str, str], SequentialRecord]:
    """Titles of the two policies of every watched comparison, where both are among the arms."""
    titles = {(row.config_hash, arm.start.value): arm.title for arm in arms for row in arm.rows[:1]}
    found = {}
    for record in records:
        own = titles.get((record.config_hash, record.start))
        other = titles.get((record.against_config_hash, record.start))
        if own is not None and other is not None:
            found[own, other] = record
    return found
