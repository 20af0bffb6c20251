"""One trajectory while it is driven: every action exactly as executed, every state seen, steps taken back
exactly.

Taking steps back is the rollback of the interventions (`replay/rollback.py`): a snapshot is restored where
snapshots are exact, otherwise task and actions are replayed, and the state's hash must be the one that was.
What is left is therefore a trajectory that never had those steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.simulator import Simulator, follow
from lerobot_roborecover.replay.handoff import SnapshotCache
from lerobot_roborecover.replay.recorder import Recorder
from lerobot_roborecover.replay.rollback import RollbackHistory
from lerobot_roborecover.rollout import MAX_PREFIX_STEPS
from lerobot_roborecover.scenario import DeviationType, Pose, ScenarioError, Stage
from lerobot_roborecover.web.teleop.starts import StartPoint
from lerobot_roborecover.web.teleop.store import Recorded, lacking

SNAPSHOTS = 200
"""Steps back that need no replay."""


@dataclass(frozen=True)
class Mark:
    """The operator's own recovery point: a suggestion, which people's votes decide about."""

    step: int
    stage: str = ""
    deviation: str = ""


class TeleopSession:
    """Drives one simulator from a start.

    Args:
        simulator: owned by the caller; used from one thread.
        operator: name; becomes the recording's controller.
    """

    def __init__(self, simulator: Simulator, operator: str):
        self.simulator, self.operator = simulator, operator
        self.controls = platform_named(simulator.platform).controls()
        self.start_point: StartPoint | None = None
        self.mark: Mark | None = None
        self._history: RollbackHistory | None = None
        self._recorder = Recorder(simulator)
        self._clear()

    def _clear(self) -> None:
        self._recorder.clear()
        self.devices: Counter[str] = Counter()
        self.rollbacks = self.undone = 0
        self.mark = None

    # --- driving

    def start(self, start: StartPoint, told: Callable[[int, int], None] = lambda _done, _of: None) -> None:
        """Puts the task where the person begins; what was under way is gone.

        Args:
            start: where.
            told: how many actions of how many that come before it have been replayed.

        Raises:
            ScenarioError: the task cannot be reset so.
            SimulatorError: likewise.
        """
        self.start_point = self._history = None
        self._clear()
        self._recorder.reset(start.task, start.reset)
        # What LIBERO draws at random becomes a part of the reset.
        start = replace(start, reset=self._recorder.reset_record)
        for step in follow(self._recorder, start.prefix):
            told(step, len(start.prefix))
        self._history = RollbackHistory(
            self.simulator,
            start.rollout,
            len(start.prefix),
            keep=SNAPSHOTS,
            cache=SnapshotCache(2**24),
        )
        self.start_point = start

    @property
    def actions(self) -> list[np.ndarray]:
        """Executed since the task's reset, (A,) float64 each."""
        return self._recorder.actions

    @property
    def bodies(self) -> list[dict[str, Pose]]:
        """Poses before the first action and after each."""
        return self._recorder.bodies

    @property
    def solved(self) -> list[bool]:
        """The task's predicate, likewise."""
        return self._recorder.solved

    @property
    def step(self) -> int:
        """Actions since the task's reset."""
        return len(self._recorder)

    def act(self, action: np.ndarray, device: str) -> None:
        """Executes and records one action.

        Args:
            action: (A,) float64, checked.
            device: what it came from.

        Raises:
            ScenarioError: nothing was started, or the recording is as long as a prefix may be.
            SimulatorError: the simulator cannot go on.
        """
        history = self._require()
        if self.step >= MAX_PREFIX_STEPS:
            raise ScenarioError(f"a recording has at most {MAX_PREFIX_STEPS} steps; save or discard it")
        history.step(action)
        self._recorder.note(action)
        self.devices[device] += 1

    def roll_back(self, steps: int) -> int:
        """Takes steps back, at most to where the person began; a mark after that goes too.

        Returns:
            How many.
        """
        history = self._require()
        count = min(steps, self.step - len(self._start.prefix))
        if count <= 0:
            return 0
        history.roll_back(count)
        target = self.step - count
        self._recorder.cut(target)
        self.rollbacks, self.undone = self.rollbacks + 1, self.undone + count
        if self.mark is not None and self.mark.step > target:
            self.mark = None
        return count

    def set_mark(self, stage: str, deviation: str) -> Mark:
        """Marks this state as the recovery point.

        Args:
            stage: a `Stage`, or empty.
            deviation: a `DeviationType`, or empty.

        Raises:
            ScenarioError: no recovery point can be here.
        """
        self._require()
        _check_labels(stage, deviation)
        if self.step <= self._start.reset.settle_steps:
            raise ScenarioError("nothing has happened yet: make a deviation first, then mark it")
        if self.solved[-1]:
            raise ScenarioError("the task is solved here; there is nothing to recover from")
        self.mark = Mark(self.step, stage, deviation)
        return self.mark

    def relabel(self, stage: str, deviation: str) -> None:
        """Gives the mark other labels, where it is.

        Raises:
            ScenarioError: there is no mark, or a label is none.
        """
        _check_labels(stage, deviation)
        if self.mark is None:
            raise ScenarioError("nothing is marked yet")
        self.mark = replace(self.mark, stage=stage, deviation=deviation)

    # --- what became of it

    @property
    def proven(self) -> bool:
        """Whether the task was solved within its horizon from the mark."""
        return self.mark is not None and not self.lacks()

    def lacks(self) -> str:
        mark = None if self.mark is None else self.mark.step
        return lacking(mark, np.array(self.solved), self._start.task.horizon)

    def recorded(self, identity: str, as_dropped: bool) -> Recorded:
        """The recording as it is to be kept.

        Args:
            identity: the candidate's id.
            as_dropped: keep one that lacks something, as dropped.

        Raises:
            ScenarioError: it lacks something, or nothing was driven.
        """
        self._require()
        start = self._start
        if self.step == len(start.prefix):
            raise ScenarioError("nothing was driven yet; there is nothing to save")
        lacks = self.lacks()
        if lacks and not as_dropped:
            raise ScenarioError(f"{lacks}: drive on, discard it, or save it as dropped")
        rollout, steps = self._recorder.rollout, self._recorder.steps
        notes: dict[str, Any] = {
            "devices": dict(self.devices),
            "rewinds": self.rollbacks,
            "steps_undone": self.undone,
            "driven_from": len(start.prefix),
            "recorded_at": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        if self.mark is not None:
            later = np.flatnonzero(self.solved[self.mark.step + 1 :])
            notes["recovery_steps"] = int(later[0]) + 1 if len(later) else None
        if start.origin:
            notes["continues"] = dict(start.origin)
        return Recorded(
            id=identity,
            operator=self.operator,
            task=rollout.task,
            reset=rollout.reset,
            actions=rollout.actions,
            bodies=steps.bodies,
            solved=steps.solved,
            mark=None if self.mark is None else (self.mark.step, self.mark.stage, self.mark.deviation),
            lacks=lacks,
            source_record=start.source_record,
            notes=notes,
            versions=self.simulator.fingerprint(),
        )

    @property
    def _start(self) -> StartPoint:
        assert self.start_point is not None
        return self.start_point

    def _require(self) -> RollbackHistory:
        if self._history is None:
            raise ScenarioError("nothing is under way; start a task first")
        return self._history


def _check_labels(stage: str, deviation: str) -> None:
    if stage not in ("", *Stage) or deviation not in ("", *DeviationType):
        raise ScenarioError(
            f"stage {stage!r:.40} and type {deviation!r:.40} must be empty or one of {', '.join(Stage)}; "
            f"{', '.join(DeviationType)}"
        )
