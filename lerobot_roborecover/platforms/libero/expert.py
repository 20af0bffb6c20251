"""The scripted controller of LIBERO's tasks, from privileged simulator state, with flaws to switch on.

Without flaws it is the expert that proves scenarios recoverable and makes demonstrations; with them it is a
weaker controller whose failures are real rollouts. It takes up a task's goals one after the other, each with
a controller of its kind, and tries again what has not worked or came undone.
"""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.platforms.libero.articulated import (
    DoorPush,
    DrawerPull,
    DrawerPush,
    JointMotion,
    KnobTurn,
)
from lerobot_roborecover.platforms.libero.catalog import PLACE_KINDS, turn_of
from lerobot_roborecover.platforms.libero.insert import PlaceInside, on_sill
from lerobot_roborecover.platforms.libero.motion import ArmMotion, Flaws
from lerobot_roborecover.platforms.libero.pick_place import PickPlace
from lerobot_roborecover.platforms.libero.push import RimSlide
from lerobot_roborecover.platforms.libero.scene import Goal, LiberoScene

__all__ = ["Flaws", "LiberoExpert"]

_WIDE = "plate"
"""What no gripper spans."""


class LiberoExpert:
    """Drives one rollout from wherever the simulator is.

    Args:
        scene: of the simulator's current reset.
        flaws: errors to make.
    """

    def __init__(self, scene: LiberoScene, flaws: Flaws | None = None):
        self._scene, self._flaws = scene, flaws or Flaws()
        self._goals = sorted(scene.goals, key=lambda goal: turn_of(goal.predicate))
        self._motion = self._next()

    def act(self) -> np.ndarray:
        """The next (7,) float64 relative OSC action."""
        if self._motion.done:
            self._motion = self._next()
        return self._motion.act()

    def _next(self) -> ArmMotion:
        """Returns the controller of the first goal that is not reached."""
        scene, flaws = self._scene, self._flaws
        pending = [g for g in self._goals if not (scene.reached(g) or on_sill(scene, g))] or self._goals[-1:]
        first = pending[0]
        if first.predicate[0] == "in" and scene.drawer(first.region) is not None:
            opened = Goal(("open", first.region), first.region)
            if not scene.reached(opened):
                return DrawerPull(scene, opened, flaws)
        if _WIDE in first.item:
            return RimSlide(scene, first, flaws)
        if first.predicate[0] in PLACE_KINDS:
            kind = PickPlace if scene.door(first.region) is None else PlaceInside
            return kind(scene, [g for g in self._goals if g.predicate[0] in PLACE_KINDS], flaws)
        return _joint_motion(scene, first, flaws)


def _joint_motion(scene: LiberoScene, goal: Goal, flaws: Flaws) -> JointMotion:
    kind = goal.predicate[0]
    if kind in ("turnon", "turnoff"):
        return KnobTurn(scene, goal, flaws)
    if kind == "open":
        return DrawerPull(scene, goal, flaws)
    if scene.joint(goal.item).hinged:
        return DoorPush(scene, goal, flaws)
    return DrawerPush(scene, goal, flaws)
