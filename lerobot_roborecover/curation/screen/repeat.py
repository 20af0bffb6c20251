"""Some trials of a screening, run once more from the recorded prefix: whether outcomes come again."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.curation.policy_trials import went_alike
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.utils.text import pluralize

Rows = Mapping[str, Sequence[TrialRow]]
"""Trials by the policy's name."""


@dataclass(frozen=True)
class Repeats:
    """What came of the trials that were run twice."""

    trials: int
    scenarios: int
    discordant: Sequence[str]
    """Of those that differ in outcome or actions: the trial, and how it ended both times."""

    @property
    def record(self) -> dict[str, Any]:
        return {"trials": self.trials, "scenarios": self.scenarios, "discordant": list(self.discordant)}

    def __str__(self) -> str:
        run = f"{pluralize(self.trials, 'trial')} of {pluralize(self.scenarios, 'scenario')} run again"
        if not self.discordant:
            return f"{run}: each with the same actions and the same outcome"
        told = "\n  ".join(self.discordant)
        return (
            f"{run}: {len(self.discordant)} differ, so outcomes of this screening do not all come again. Run "
            f"it with --max-batch 1 and on one kind of processor:\n  {told}"
        )


def draw_repeated(ids: Sequence[str], share: float, seed: int) -> set[str]:
    """The scenarios whose trials are run again: this share of them, at least one, drawn at random.

    Args:
        ids: of all that were screened, in any order.
        share: 0 to 1.
        seed: of the draw.
    """
    ordered = sorted(ids)
    count = min(math.ceil(share * len(ordered)), len(ordered))
    drawn = np.random.default_rng([seed, len(ordered)]).permutation(len(ordered))[:count]
    return {ordered[n] for n in drawn}


def run_again(rows: Rows, ids: set[str], run: Callable[[str, int, set[str]], Sequence[TrialRow]]) -> Repeats:
    """Runs the trials of these scenarios again and compares.

    Args:
        rows: all trials of the screening.
        ids: of `draw_repeated`.
        run: runs so many trials of these scenarios by the policy of this name, and returns their rows.
    """
    compared, discordant = 0, []
    for name, first in rows.items():
        mine = {(r.scenario_id, r.trial): r for r in first if r.scenario_id in ids}
        counts = Counter(scenario for scenario, _ in mine)
        for trials in sorted(set(counts.values())):
            for row in run(name, trials, {s for s, n in counts.items() if n == trials}):
                before = mine[row.scenario_id, row.trial]
                compared += 1
                if not went_alike(before, row):
                    discordant.append(
                        f"{name}, {row.scenario_id}, trial {row.trial}: {_told(before)}, then {_told(row)}"
                    )
    return Repeats(compared, len(ids), tuple(discordant))


def _told(row: TrialRow) -> str:
    return f"{row.outcome} after {pluralize(row.steps, 'step')}"
