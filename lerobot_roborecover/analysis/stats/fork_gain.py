"""Computes the gain of an intervention from forks: P(success | intervene) - P(success | continue).

Every fork of an arm is compared with the continuation from the same step of the same logged trial on the
same random stream. A scenario's number is the mean of its differences, whatever the number of its forks;
intervals are over scenarios (or what else is independent, `analysis.stats.units`), as everywhere. Forks of
which one of the two is invalid are left out and counted.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.units import (
    ResamplingUnit,
    default_unit,
    initial_unit,
    unit_labels,
)
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Outcome, ScenarioError, Start

FORK = "fork"
"""Entry of a row's `options` that says which fork it is."""
CONTINUE = "continue"
"""The arm without an intervention: the same policy goes on."""
MATCHED = "matched"
"""The random stream of forks that are compared: one new stream for all arms."""


@dataclass(frozen=True)
class ForkNote:
    of: str
    """`config_hash` of the logged trial's row; its scenario and its trial are the row's own."""
    actions_sha256: str
    """Hash of the logged trial's actions."""
    step: int
    """New steps of the logged trial before the fork."""
    arm: str
    """`continue`, `fresh`, `rollback:30`, `correction:...`, `policy:...`, `human:...`."""
    repeat: int
    """Which of the matched random streams."""
    stream: str
    """`matched`: one new stream for all arms. The others are continuations that check: on `own` the logged
    trial's stream goes on, and on `another` a policy that is said to be deterministic has a third one; the
    trial must end as it did."""

    def as_json(self) -> dict[str, Any]:
        """For `TrialRow.options`."""
        return asdict(self)


def note_of(row: TrialRow) -> ForkNote | None:
    """Which fork a row is of; None where it is of none.

    Raises:
        ScenarioError: it says so in words of another version.
    """
    if FORK not in row.options:
        return None
    try:
        return ForkNote(**row.options[FORK])
    except TypeError as err:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id}: options.fork cannot be read ({err}); it was written by "
            "another version. Run roborecover detect fork again"
        ) from None


@dataclass(frozen=True)
class ForkPair:
    """A fork, and its parent's continuation."""

    note: ForkNote
    row: TrialRow
    continued: TrialRow

    @property
    def difference(self) -> float:
        """-1 (harmed), 0 or 1 (rescued)."""
        return float(self.row.success) - float(self.continued.success)

    @property
    def cell(self) -> str:
        """Stage and deviation."""
        return f"{self.row.stage} / {self.row.deviation}"


@dataclass(frozen=True)
class ForkGains:
    """What the forks of a log say."""

    pairs: tuple[ForkPair, ...]
    arms: tuple[str, ...]
    unpaired: int
    """Forks left out: invalid, or without a valid continuation."""
    reproduced: tuple[int, int]
    """Of so many continuations that check, how many are the logged trial's rest, action for action."""
    unit: ResamplingUnit

    @property
    def steps(self) -> list[int]:
        return sorted({p.note.step for p in self.pairs})

    @property
    def cells(self) -> list[str]:
        return sorted({p.cell for p in self.pairs})

    def of(
        self, arm: str, step: int | None = None, cell: str | None = None
    ) -> tuple[int, int, Estimate, Estimate, Estimate]:
        """One arm's numbers, of all forks or of some.

        Returns:
            Forks, scenarios, P(success | continue), P(success | intervene), and the gain.
        """
        mine = [
            p
            for p in self.pairs
            if p.note.arm == arm and step in (None, p.note.step) and cell in (None, p.cell)
        ]
        own: dict[str, list[ForkPair]] = defaultdict(list)
        for pair in mine:
            own[pair.row.scenario_id].append(pair)
        firsts = [pairs[0].row for pairs in own.values()]
        labels = unit_labels(
            self.unit,
            list(own),
            [r.cluster for r in firsts],
            [f"{r.suite}/{r.task}" for r in firsts],
            [r.first_state for r in firsts],
        )
        draws = resample(labels)

        def means(of: Callable[[ForkPair], float]) -> np.ndarray:
            return np.array([[np.mean([of(p) for p in pairs])] for pairs in own.values()], float)

        if not own:
            nothing = Estimate(np.nan, np.nan, np.nan)
            return 0, 0, nothing, nothing, nothing
        (continued,) = draws.rates(means(lambda p: float(p.continued.success)))
        (stepped_in,) = draws.rates(means(lambda p: float(p.row.success)))
        (gain,) = draws.differences(means(lambda p: p.difference))
        return len(mine), len(own), continued, stepped_in, gain


def fork_gains(rows: Iterable[TrialRow], unit: ResamplingUnit | None = None) -> ForkGains:
    """Pairs every fork with its continuation.

    Args:
        rows: of a log of forks.
        unit: what is independent; by default the platform's, and first states where initial-state trials
            are forked.

    Raises:
        ScenarioError: no row is of a fork, or no fork has its continuation.
    """
    continued: dict[tuple, TrialRow] = {}
    others: list[tuple[tuple, ForkNote, TrialRow]] = []
    reproduced = checked = 0
    platform = ""
    for row in rows:
        note = note_of(row)
        if note is None:
            continue
        platform = row.platform
        if note.stream != MATCHED:
            checked += 1
            reproduced += row.actions_sha256 == note.actions_sha256
            continue
        key = (row.scenario_id, row.start, row.trial, note.of, note.step, note.repeat)
        if note.arm != CONTINUE:
            others.append((key, note, row))
        elif Outcome(row.outcome).valid:
            continued[key] = row
    if not platform:
        raise ScenarioError("the log has no forks; roborecover detect fork writes some")
    pairs = [
        ForkPair(note, row, continued[key])
        for key, note, row in others
        if Outcome(row.outcome).valid and key in continued
    ]
    if not pairs:
        raise ScenarioError(
            f"none of the {len(others)} forks has a valid continuation to be compared with; the rows' "
            "`reason` says why"
        )
    arms = tuple(dict.fromkeys(p.note.arm for p in pairs))
    if unit is None:
        initial = any(p.row.start == Start.INITIAL for p in pairs)
        unit = initial_unit(None) if initial else default_unit(platform)
    return ForkGains(tuple(pairs), arms, len(others) - len(pairs), (reproduced, checked), unit)
