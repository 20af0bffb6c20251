"""Where a failed Meta-World rollout went wrong, and what to call it: the rules behind the starter set's
labels.

They turn the paper's definitions ("Recovery Stage and Deviation Type", "Stage-Type and Recovery Point
Annotation") into measurements for pick-, push- and tool-tasks with one object to handle.

Recovery point: the first step at which a deviation is present and stable, after the last event of the
rollout. An event is the object moving by more than 5 cm again, tipping over, or coming nearer to its place:
from the recovery point on, the rollout stays stuck.

Recovery stage, by what has to be resumed:

- Move: the object is in the grasp, away from where it has to go. Place: in the grasp, within 10 cm of there.
- Contact: not in the grasp, fingertips within 8 cm of the object. Approach: more than 12 cm away. In between
  people would disagree: no recovery point.

Deviation type, the first that applies:

- Wrong Target: a part that is not to be handled (the nail before the hammer, the machine's button) was
  moved, and the fingertips are within 6 cm of it.
- Stage Rollback: the object had been in the grasp and carried by more than 2 cm, and now is more than 5 cm
  from the fingertips. Nearer than that no picture shows whether it is held: no recovery point.
- Scene Change: never grasped, but knocked more than 4 cm aside or tilted by more than 30 degrees.
- Wrong Pose: the scene is as it should be, but the hand, empty or with the object, is stuck where the task
  does not go on: it moves less than 1.5 cm from 20 steps before to 20 steps after the recovery point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.metaworld.marks import FINAL_OFFSET_M
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.scenario import DeviationType, Stage

CONTACT_DISTANCE_M, APPROACH_DISTANCE_M = 0.08, 0.12
PLACE_DISTANCE_M = 0.10
KNOCKED_M = 0.04
CARRIED_M = 0.02
EVENT_M = 0.05
TILTED_RAD = np.deg2rad(30.0)
STUCK_M = 0.015
STUCK_STEPS = 20
RESTING_M = 0.004
RESTING_STEPS = 12
OTHER_MOVED_M = 0.01
OTHER_TOUCHED_M = 0.06
LOST_M = 0.05

_OTHER_PARTS = ("nail_link", "cmbutton")


@dataclass
class Trace:
    """What the rules look at, one row a step before its action; `watch` fills it."""

    task_name: str
    raw: list[np.ndarray] = field(default_factory=list)
    """(39,) Meta-World observations."""
    fingertips: list[np.ndarray] = field(default_factory=list)
    """(3,) point between the fingertips."""
    held: list[bool] = field(default_factory=list)
    """Both fingers touch the object to handle."""
    others: list[np.ndarray] = field(default_factory=list)
    """(n, 3) positions of the parts not to be handled."""

    def object_m(self) -> np.ndarray:
        """(T, 3) position of the object to handle."""
        return np.array(self.raw)[:, 4:7]

    def tilt_rad(self) -> np.ndarray:
        """(T,) angle of the object's rotation since the start about horizontal axes."""
        turns = Rotation.from_quat(np.array(self.raw)[:, 7:11])
        relative = (turns * turns[0].inv()).as_matrix()
        return np.arccos(np.clip(relative[:, 2, 2], -1.0, 1.0))

    def remaining_m(self) -> np.ndarray:
        """(T,) distance of the object from where it has to go."""
        goal = np.array(self.raw)[:, 36:39] + FINAL_OFFSET_M.get(self.task_name, (0.0, 0.0, 0.0))
        return np.linalg.norm(self.object_m() - goal, axis=1)


def watch(
    simulator: MetaworldSimulator, task_name: str, act: Callable[[int], np.ndarray]
) -> tuple[Callable[[int], np.ndarray], Trace]:
    """The controller, and the trace that fills while it drives."""
    trace = Trace(task_name)

    def watched(t: int) -> np.ndarray:
        bodies = simulator.bodies()
        trace.raw.append(simulator.low_dim())
        trace.fingertips.append(np.array(bodies["eef"].position_m))
        trace.held.append(bool(simulator.grasped() - set(_OTHER_PARTS)))
        others = [bodies[name].position_m for name in _OTHER_PARTS if name in bodies]
        trace.others.append(np.array(others).reshape(-1, 3))
        return act(t)

    return watched, trace


def recovery_point(trace: Trace) -> tuple[int, Stage, DeviationType] | None:
    """The final stable deviation of a failed rollout, or None where the rules see none."""
    rules = _Rules(trace)
    last = len(trace.raw) - 2 * STUCK_STEPS
    for t in range(STUCK_STEPS, last):
        if rules.event_follows(t):
            continue
        found = rules.label(t)
        if found is not None and found == rules.label(t + STUCK_STEPS // 2):
            return t, *found
    return None


class _Rules:
    """The measurements of a trace, and the label of a step."""

    def __init__(self, trace: Trace):
        self._object = trace.object_m()
        self._hand = np.array(trace.fingertips)
        self._held = np.array(trace.held)
        self._remaining = trace.remaining_m()
        self._tilt = trace.tilt_rad()
        others = np.array(trace.others)
        moved = np.linalg.norm(others - others[:1], axis=2) > OTHER_MOVED_M
        near = np.linalg.norm(others - self._hand[:, None], axis=2) < OTHER_TOUCHED_M
        self._at_wrong_part = (moved & near).any(axis=1)
        self._reach = np.linalg.norm(self._hand - self._object, axis=1)
        self._carried = self._carried_so_far()

    def event_follows(self, t: int) -> bool:
        """Whether the object moves or tips again, or is brought nearer its place, later than step t."""
        moves = np.linalg.norm(self._object[t:] - self._object[t], axis=1).max() > EVENT_M
        tips = np.abs(self._tilt[t:] - self._tilt[t]).max() > TILTED_RAD
        return bool(moves or tips or self._remaining[t:].min() < self._remaining[t] - EVENT_M / 2)

    def label(self, t: int) -> tuple[Stage, DeviationType] | None:
        """Stage and type of a stable deviation at step t, or None where there is none (yet)."""
        if _span(self._object[t - RESTING_STEPS : t + 1]) > RESTING_M:
            return None
        stuck = _span(self._hand[t - STUCK_STEPS : t + STUCK_STEPS + 1]) < STUCK_M
        held = self._held[t - 3 : t + 1].all()
        if held != self._held[t - 3 : t + 1].any():
            return None
        if held:
            stage = Stage.PLACE if self._remaining[t] < PLACE_DISTANCE_M else Stage.MOVE
        else:
            if CONTACT_DISTANCE_M < self._reach[t] < APPROACH_DISTANCE_M:
                return None
            stage = Stage.CONTACT if self._reach[t] <= CONTACT_DISTANCE_M else Stage.APPROACH
        if self._at_wrong_part[t] and not self._carried[t]:
            return stage, DeviationType.WRONG_TARGET
        if not held and self._carried[t]:
            return (stage, DeviationType.STAGE_ROLLBACK) if self._reach[t] > LOST_M else None
        # Sideways only: the box's lid falls by 8 cm by itself when its task starts.
        aside = np.linalg.norm(self._object[t, :2] - self._object[0, :2]) > KNOCKED_M
        if not held and (aside or self._tilt[t] > TILTED_RAD):
            return stage, DeviationType.SCENE_CHANGE
        return (stage, DeviationType.WRONG_POSE) if stuck else None

    def _carried_so_far(self) -> np.ndarray:
        """(T,) whether the object was carried by more than `CARRIED_M` within one grasp up to each step."""
        carried = np.zeros(len(self._held), dtype=bool)
        grasp_began: int | None = None
        for t, held in enumerate(self._held):
            carried[t] = carried[t - 1] if t else False
            if not held:
                grasp_began = None
            elif grasp_began is None:
                grasp_began = t
            elif np.linalg.norm(self._object[t] - self._object[grasp_began]) > CARRIED_M:
                carried[t] = True
        return carried


def _span(points: np.ndarray) -> float:
    """Largest distance of the (n, 3) points from the last one."""
    return float(np.linalg.norm(points - points[-1], axis=1).max())
