"""What was executed, as one line of actions that can be replayed: the sources of training data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.fork_gain import MATCHED, note_of
from lerobot_roborecover.curation.continuations import from_rollouts
from lerobot_roborecover.curation.split import MEASURED
from lerobot_roborecover.datasets.trajectories import TrajectorySet
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, TrialRow, read_actions
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Outcome, Scenario

OTHERS = ("correction", "takeover")
"""Interventions in which another policy or a person acts for some steps."""


@dataclass(frozen=True)
class TrainingLine:
    """One episode to be: a scenario's prefix as far as it goes, and the actions after it."""

    scenario: Scenario
    """With its whole prefix."""
    replayed: int
    """Prefix actions before the first one."""
    actions: np.ndarray
    """(n, A) in the type in which they were executed."""
    first: int
    """Actions that are only replayed: the episode begins after them."""
    intervention: np.ndarray
    """(n,) bool: the action was not chosen by the trial's policy."""
    success: bool
    driver: str
    trial: int
    progress: np.ndarray | None = None
    """(n,) of the task before each action, from 0 to 1, where a log says so."""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def start(self) -> Scenario:
        """The scenario with the prefix that is replayed."""
        if self.replayed == len(self.scenario.prefix):
            return self.scenario
        return replace(self.scenario, prefix=self.scenario.prefix[: self.replayed], fingerprint=None)

    @property
    def steps(self) -> int:
        return len(self.actions) - self.first

    @property
    def state_steps(self) -> np.ndarray:
        """(steps,) numbers of the states before the episode's actions, of prefix and actions together."""
        return np.arange(self.first, len(self.actions)) + self.replayed


def lines_of_log(
    log: Path, scenarios: Mapping[str, Scenario], dropped: Counter, of: str = "all"
) -> list[TrainingLine]:
    """Episodes of a log's trials; what cannot be used is counted by its reason.

    Args:
        log: of trials, or of forks, with actions beside it.
        scenarios: by id.
        dropped: counts.
        of: `all`, `successes` or `failures`.

    Raises:
        ScenarioError: actions were not recorded, or are others.
        TrialLogError: the log is damaged.
    """
    found = []
    for row in read_trial_log(log):
        scenario = scenarios.get(row.scenario_id)
        reason = _why_not(row, scenario, of)
        if reason or scenario is None:
            dropped[reason] += 1
        else:
            found.append(line_of_trial(scenario, row, read_actions(log.with_name(ACTIONS_FOLDER), row)))
    return found


def _why_not(row: TrialRow, scenario: Scenario | None, of: str) -> str:
    if scenario is None:
        return "of no scenario of the set"
    if scenario.sha256() != row.scenario_sha256:
        return "of another version of its scenario"
    if not Outcome(row.outcome).valid or not row.steps:
        return f"outcome {row.outcome}"
    if of != "all" and row.success != (of == "successes"):
        return f"not among the {of} (--outcome)"
    note = note_of(row)
    if note is not None and note.stream != MATCHED:
        return "a fork that only repeats its trial"
    mode = row.options.get("control_mode")
    if mode not in (None, platform_named(row.platform).records_control_mode):
        return f"actions of control mode {mode}, which the recorded ones are not"
    return ""


def line_of_trial(scenario: Scenario, row: TrialRow, actions: np.ndarray) -> TrainingLine:
    """A trial as one line: what rollbacks undid is taken out, and who chose each action is kept.

    Args:
        scenario: the row's.
        row: the trial's.
        actions: (n, A) all that it executed.
    """
    note = note_of(row)
    kept, replayed = list(range(len(actions))), row.handoff_step
    other = np.zeros(len(actions), bool)
    begins = 0 if note is None else note.step
    if note is not None and note.arm.startswith("policy:"):
        other[note.step :] = True
    for entry in row.interventions:
        if not isinstance(entry, Mapping):
            continue
        if entry["kind"] in OTHERS:
            other[entry["step"] : entry["step"] + entry["steps"]] = True
        elif entry["kind"] == "rollback":
            before = [i for i in kept if i < entry["step"]]
            gone = entry.get("distance", 0)
            if entry.get("by") != "fork":  # a fork's handoff went back already
                replayed -= max(gone - len(before), 0)
            kept = before[: max(len(before) - gone, 0)] + [i for i in kept if i >= entry["step"]]
    index = np.array(kept, int)
    known = None
    if row.progress is not None and note is None and len(row.progress) > len(actions):
        known = np.asarray(row.progress[: len(actions)], float)[index] / 100
    return TrainingLine(
        scenario,
        replayed,
        actions[index],
        int((index < begins).sum()),
        other[index],
        row.success,
        row.policy,
        row.trial,
        known,
        {"log": row.config_hash, "actions_dtype": str(actions.dtype)}
        | ({} if note is None else {"fork": note.as_json()}),
    )


def lines_of_dataset(
    data: TrajectorySet, scenarios: Mapping[str, Scenario], dropped: Counter
) -> list[TrainingLine]:
    """Episodes of donors, or of rollouts that continue scenarios: another's than the trained policy."""
    kinds = {(r.driver, r.trial or 0): r.provenance.get("actions_dtype", "float64") for r in data.rows}
    found = []
    for one in from_rollouts(data, scenarios, dropped):
        actions = one.actions.astype(kinds.get((one.driver, one.trial), "float64"))
        found.append(
            TrainingLine(
                one.scenario, len(one.scenario.prefix), actions, 0, np.ones(len(actions), bool), one.success,
                one.driver, one.trial, None, {"dataset": data.root.name, "actions_dtype": str(actions.dtype)},
            )
        )  # fmt: skip
    return found


def trainable(lines: Iterable[TrainingLine], dropped: Counter) -> list[TrainingLine]:
    """Returns the lines that have a step and whose scenarios may train."""
    found = []
    for line in lines:
        if (split := line.scenario.split) in MEASURED:
            dropped[f"of the {split} split, which must not train anything"] += 1
        elif line.steps < 1:
            dropped["without a step of its own"] += 1
        else:
            found.append(line)
    return found


def policies_of(lines: Sequence[TrainingLine]) -> list[str]:
    """Returns the names of the acting policies."""
    return sorted({line.driver for line in lines})
