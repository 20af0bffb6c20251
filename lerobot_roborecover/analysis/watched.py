"""Pairs of policies whose comparison may have been looked at while it ran: the test of `sequential.py`."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from lerobot_roborecover.analysis.arms import Arm
from lerobot_roborecover.analysis.contrasts import Contrast
from lerobot_roborecover.analysis.panel import Panel
from lerobot_roborecover.analysis.sequential import SequentialTest, grid_of, sequence, whole_units
from lerobot_roborecover.analysis.sequential_record import SequentialRecord
from lerobot_roborecover.analysis.units import WORDS


def watched_pair(
    panel: Panel,
    pair: tuple[int, int],
    level: float,
    *,
    scenarios: Collection[str] | None = None,
    trials: int | None = None,
    planned_level: float | None = None,
) -> Contrast:
    """The sequential contrast of two policies, on the scenarios whose turn has come.

    Args:
        panel: their trials.
        pair: indices of arms; the first minus the second.
        level: confidence level at which a verdict is wanted.
        scenarios: ids that the comparison was to be over; by default all of the panel.
        trials: that each scenario was to have from the first policy; by default as many as most have.
        planned_level: level at which it was to stop; by default `level`.
    """
    a, b = pair
    ids = [s.id for s in panel.scenarios]
    chosen = set(ids if scenarios is None else scenarios)
    labels = dict(zip(ids, panel.units().tolist(), strict=True))
    members: dict[str, list[str]] = {}
    for scenario in sorted(chosen):
        # One that nobody here was run on has no row that says its cluster: it is a unit that never comes.
        members.setdefault(labels.get(scenario, f"scenario:{scenario}"), []).append(scenario)
    counts = panel.trials[[a, b]]
    needed = [trials or _usual(counts[0]), 1 if trials else _usual(counts[1])]
    there = {
        i for n, i in enumerate(ids) if i in chosen and (counts[:, n] >= needed).all() and counts[:, n].all()
    }
    test = SequentialTest(
        len(members), grid_of(counts[counts > 0].tolist()), level if planned_level is None else planned_level
    )
    place = {i: n for n, i in enumerate(ids)}
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


def _usual(counts: np.ndarray) -> int:
    """Trials that most scenarios have, of those with any."""
    values, often = np.unique(counts[counts > 0], return_counts=True)
    return int(values[often.argmax()]) if len(values) else 1


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
