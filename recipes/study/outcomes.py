"""What came of every trial, small enough to keep with the code, and the comparison with a run of today."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import ScenarioError
from recipes.study.arms import StudyArm

COLUMNS = ("arm", "scenario_id", "trial", "outcome", "steps")

type Key = tuple[str, str, int]
"""Arm, scenario, trial."""
type Outcomes = Mapping[Key, tuple[str, int]]
"""Outcome and steps of each trial."""
type Difference = tuple[Key, tuple[str, int], tuple[str, int]]
"""Key, stored, today."""

STEPS_BAND = 2
"""Where kernels cannot be chosen: how many steps apart a trial that ends alike may end."""


@dataclass(frozen=True)
class ReproductionCheck:
    """Trials of today against the stored ones."""

    same: int
    different: tuple[Difference, ...]
    unknown: int
    """Trials of today that are not stored."""
    close: tuple[Difference, ...] = ()
    """Trials that ended alike, after other steps, within the band."""
    steps_band: int = 0
    """How many steps apart a trial that ends alike may end."""

    def text(self, limit: int = 10) -> str:
        """A few lines for people."""
        compared = self.same + len(self.different) + len(self.close)
        lines = [f"{self.same} of {compared} trials came out as stored, to the step"]
        if self.close:
            lines.append(
                f"{len(self.close)} more ended alike, at most {self.steps_band} steps sooner or later: this "
                "processor cannot take the kernels that the stored ones were computed with"
            )
        if self.unknown:
            lines.append(f"{self.unknown} trials are not among the stored ones")
        for (arm, scenario, trial), stored, today in self.different[:limit]:
            lines.append(
                f"  {arm} {scenario} trial {trial}: stored {stored[0]} after {stored[1]} steps, today "
                f"{today[0]} after {today[1]}"
            )
        if len(self.different) > limit:
            lines.append(f"  ... and {len(self.different) - limit} more")
        return "\n".join(lines)


def outcomes_of(arms: Iterable[StudyArm]) -> dict[Key, tuple[str, int]]:
    """Outcomes in the arms' trial logs."""
    found = {}
    for arm in arms:
        for row in read_trial_log(arm.log):
            found[arm.label, row.scenario_id, row.trial] = (str(row.outcome), row.steps)
    return found


def write_outcomes(path: Path, outcomes: Outcomes) -> None:
    """Writes `outcomes.csv`, sorted, so that two runs differ only where their trials do."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for key in sorted(outcomes):
            writer.writerow([*key, *outcomes[key]])


def read_outcomes(path: Path) -> dict[Key, tuple[str, int]]:
    """Reads `outcomes.csv`.

    Raises:
        ScenarioError: names the line.
    """
    found: dict[Key, tuple[str, int]] = {}
    with path.open(newline="") as file:
        reader = csv.reader(file)
        if tuple(next(reader, ())) != COLUMNS:
            raise ScenarioError(f"{path}: the first line must be {','.join(COLUMNS)}")
        for number, row in enumerate(reader, 2):
            try:
                arm, scenario, trial, outcome, steps = row
                found[arm, scenario, int(trial)] = (outcome, int(steps))
            except ValueError as err:
                raise ScenarioError(f"{path}, line {number}: {row!r:.200} is not a trial ({err})") from None
    return found


def compare(stored: Outcomes, today: Outcomes, steps_band: int = 0) -> ReproductionCheck:
    """Compares the trials that are in both.

    Args:
        stored: of the machine that stored them.
        today: of this one.
        steps_band: how many steps apart a trial may end whose outcome is the stored one.
    """
    both = sorted(stored.keys() & today.keys())
    other = [(k, stored[k], today[k]) for k in both if stored[k] != today[k]]

    def near(difference: Difference) -> bool:
        (before, then), (outcome, steps) = difference[1:]
        return before == outcome and abs(steps - then) <= steps_band

    return ReproductionCheck(
        same=len(both) - len(other),
        different=tuple(d for d in other if not near(d)),
        unknown=len(today.keys() - stored.keys()),
        close=tuple(d for d in other if near(d)),
        steps_band=steps_band,
    )
