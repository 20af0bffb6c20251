"""One trajectory while it is driven: every action exactly as executed, every state seen, steps taken back
exactly.

Taking steps back is the rollback of the interventions (`env/rewind.py`): a snapshot is restored where
snapshots are exact, otherwise task and actions are replayed, and the state's hash must be the one that was.
What is left is therefore a trajectory that never had those steps.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from lerobot_roborecover.build.teleop.controls import controls_of
from lerobot_roborecover.build.teleop.starts import StartPoint
from lerobot_roborecover.build.teleop.store import Recorded
from lerobot_roborecover.env.rewind import Trail
from lerobot_roborecover.replay import SnapshotCache
from lerobot_roborecover.scenario import (
    MAX_PREFIX_STEPS,
    DeviationType,
    Pose,
    Scenario,
    ScenarioError,
    Source,
    Stage,
)
from lerobot_roborecover.simulators.base import Simulator

SNAPSHOTS = 200
"""Steps back that need no replay."""


@dataclass(frozen=True)
class Mark:
    """The operator's own recovery point: a suggestion, which people's votes decide about."""

    step: int
    stage: str = ""
    deviation: str = ""


class Session:
    """Drives one simulator from a start.

    Args:
        simulator: owned by whoever calls; used from one thread.
        operator: who drives; becomes the recording's driver.
    """

    def __init__(self, simulator: Simulator, operator: str):
        self.simulator, self.operator = simulator, operator
        self.controls = controls_of(simulator.platform)
        self.start_point: StartPoint | None = None
        self.mark: Mark | None = None
        self._trail: Trail | None = None
        self._clear()

    def _clear(self) -> None:
        self.actions: list[np.ndarray] = []
        self.bodies: list[dict[str, Pose]] = []
        self.solved: list[bool] = []
        self.devices: Counter[str] = Counter()
        self.rewinds = self.undone = 0
        self.mark = None

    # --- driving

    def start(self, start: StartPoint) -> None:
        """Puts the task where the person begins; what was under way is gone.

        Raises:
            ScenarioError: the task cannot be reset so.
            SimulatorError: likewise.
        """
        self.start_point = self._trail = None
        self._clear()
        self.simulator.reset(start.task, start.reset)
        if not start.reset.fixtures:
            # What LIBERO draws at random becomes a part of the reset.
            start = replace(start, reset=replace(start.reset, fixtures=dict(self.simulator.fixtures())))
        self._look()
        for action in start.prefix:
            self.simulator.step(action)
            self.actions.append(action)
            self._look()
        # The labels of a scenario do not matter to a trail; nobody sees this one.
        scenario = Scenario(
            "teleop", start.task, start.reset, start.prefix, Stage.APPROACH, DeviationType.WRONG_POSE,
            Source.HUMAN,
        )  # fmt: skip
        cache = SnapshotCache(2**24)
        self._trail = Trail(self.simulator, scenario, len(start.prefix), keep=SNAPSHOTS, cache=cache)
        self.start_point = start

    def _look(self) -> None:
        self.bodies.append(self.simulator.bodies())
        self.solved.append(bool(self.simulator.succeeded()))

    @property
    def step(self) -> int:
        """Actions since the task's reset."""
        return len(self.actions)

    def act(self, action: np.ndarray, device: str) -> None:
        """Executes and records one action.

        Args:
            action: (A,) float64, checked.
            device: what it came from.

        Raises:
            ScenarioError: nothing was started, or the recording is as long as a prefix may be.
            SimulatorError: the simulator cannot go on.
        """
        trail = self._require()
        if self.step >= MAX_PREFIX_STEPS:
            raise ScenarioError(f"a recording has at most {MAX_PREFIX_STEPS} steps; save or discard it")
        trail.step(action)
        self.actions.append(np.array(action, dtype=np.float64))
        self.devices[device] += 1
        self._look()

    def back(self, steps: int) -> int:
        """Takes steps back, at most to where the person began; a mark after that goes too.

        Returns:
            How many.
        """
        trail = self._require()
        count = min(steps, self.step - len(self._start.prefix))
        if count <= 0:
            return 0
        trail.back(count)
        target = self.step - count
        del self.actions[target:], self.bodies[target + 1 :], self.solved[target + 1 :]
        self.rewinds, self.undone = self.rewinds + 1, self.undone + count
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
        """Whether the task was solved after the mark."""
        return self.mark is not None and any(self.solved[self.mark.step + 1 :])

    def lacks(self) -> str:
        """What keeps the recording from being a candidate, in words; empty where nothing does."""
        if self.mark is None:
            return "no recovery point marked"
        return "" if self.proven else "not solved after the mark"

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
        names = list(self.bodies[0])
        poses = np.array([[[*b[n].position_m, *b[n].quat_xyzw] for b in self.bodies] for n in names])
        notes: dict[str, Any] = {
            "devices": dict(self.devices),
            "rewinds": self.rewinds,
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
            task=start.task,
            reset=start.reset,
            actions=np.array(self.actions),
            bodies=dict(zip(names, poses, strict=True)),
            solved=np.array(self.solved),
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

    def _require(self) -> Trail:
        if self._trail is None:
            raise ScenarioError("nothing is under way; start a task first")
        return self._trail


def _check_labels(stage: str, deviation: str) -> None:
    if stage not in ("", *Stage) or deviation not in ("", *DeviationType):
        raise ScenarioError(
            f"stage {stage!r:.40} and type {deviation!r:.40} must be empty or one of {', '.join(Stage)}; "
            f"{', '.join(DeviationType)}"
        )
