"""Initial states to roll out from: which tasks, which seeds or init states, listed or drawn."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.starts import MAX_STARTS, Starts
from lerobot_roborecover.scenario import Reset, ScenarioError, Source, Task, TrialStart

_NAME_PART = 56
"""Characters of a task's name in an id, before it is cut and a hash takes the rest's place."""


@dataclass(frozen=True)
class RolloutSpec(TrialStart):
    """A rollout to be made, from a task's first state: its prefix is nothing but the settling actions."""

    driver: str
    """Recorded name of the controller."""
    trial: int
    """Trial of the rollouts from this start."""
    perturbed: bool
    """Whether the driver's actions are perturbed."""
    twin: bool = False
    """It is the undisturbed twin of a perturbed rollout; of the same id, so that a policy draws the same
    noise."""

    @property
    def source(self) -> Source:
        """Of the candidate that the rollout may become."""
        return Source.PERTURBED if self.perturbed else Source.NATURAL

    @property
    def disturbed(self) -> bool:
        """Whether this very rollout's actions are perturbed."""
        return self.perturbed and not self.twin

    @property
    def record_name(self) -> str:
        """Name of the record: the candidate's id, or that of its undisturbed twin."""
        return f"{self.id}.twin" if self.twin else self.id


def make_units(
    tasks: Sequence[Task], starts: Starts, driver: str, settle_action: np.ndarray, *, perturbed: bool
) -> list[RolloutSpec]:
    """Lists the rollouts to make, task by task.

    Args:
        tasks: tasks to collect on.
        starts: resets of each task.
        driver: recorded name of the controller.
        settle_action: (A,) repeated while settling.
        perturbed: whether actions are perturbed.

    Raises:
        ScenarioError: there are too many, or two have the same id.
    """
    made: dict[str, RolloutSpec] = {}
    for task in tasks:
        for reset in platform_named(task.platform).resets(task, starts):
            for trial in range(starts.trials):
                id_ = _id(task, driver, reset, trial if starts.trials > 1 else None, perturbed)
                if id_ in made:
                    raise ScenarioError(f"two rollouts would have the id {id_!r}; collect those tasks apart")
                settling = np.tile(np.asarray(settle_action, np.float64), (reset.settle_steps, 1))
                made[id_] = RolloutSpec(id_, task, reset, settling, driver, trial, perturbed)
        if len(made) > MAX_STARTS:
            raise ScenarioError(f"more than {MAX_STARTS} rollouts; collect in several folders")
    return list(made.values())


def _id(task: Task, driver: str, reset: Reset, trial: int | None, perturbed: bool) -> str:
    name = platform_named(task.platform).short_name(task)
    start = f"s{reset.seed}" if reset.init_state_index is None else f"i{reset.init_state_index}"
    parts = [_cut(name, _NAME_PART), _cut(driver.split("@")[0], 32), *(["perturbed"] if perturbed else [])]
    return "-".join([*parts, start, *([] if trial is None else [f"t{trial}"])])


def _cut(text: str, longest: int) -> str:
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._-") or "unnamed"
    if len(plain) <= longest and plain == text:
        return plain
    mark = hashlib.sha256(text.encode()).hexdigest()[:6]
    return f"{plain[: longest - 7]}-{mark}" if len(plain) > longest - 7 else f"{plain}-{mark}"
