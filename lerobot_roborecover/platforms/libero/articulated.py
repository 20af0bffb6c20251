"""Scripted controllers for what turns or slides on a joint: drawers, a stove's knob, a microwave's door."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.libero.motion import CLOSED, OPEN, ClearMotion, Flaws
from lerobot_roborecover.platforms.libero.scene import FixtureJoint, Goal, LiberoScene

_DOWN, _UP = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
_PULL_TILT_RAD, _PUSH_TILT_RAD = 1.25, 0.6
"""How far the hand leans towards a drawer's front, from straight down: handles stand above one another, and a
hand that hangs down would meet those above."""


class JointMotion(ClearMotion, ABC):
    """A controller of one joint: approaches from `_standoff_m`, then works from `_contact_m`.

    Args:
        scene: of the simulator's current reset.
        goal: whose joint.
        flaws: errors to make.
    """

    grip = OPEN
    """Gripper on the way."""

    def __init__(self, scene: LiberoScene, goal: Goal, flaws: Flaws | None = None):
        super().__init__(scene, goal, flaws)
        self._aim = np.array(self._flaws.aim_m) + np.array([0.0, 0.0, -self._flaws.carry_m / 2])
        self._start()

    @property
    def _joint(self) -> FixtureJoint:
        return self._scene.joint(self.goal.item)

    def _start(self) -> None:
        self._plan()
        self._enter("release" if self._scene.held else "rise")

    @abstractmethod
    def _plan(self) -> None:
        """Sets `_grip_rotation`."""

    @abstractmethod
    def _contact(self) -> np.ndarray:
        """(3,) metres: where the hand begins to work."""

    @abstractmethod
    def _standoff(self) -> np.ndarray:
        """(3,) metres: where the hand waits before that."""

    def _rise(self) -> np.ndarray:
        """Up from among the objects."""
        clear = self._scene.clear_m
        if self._scene.hand_m[2] > clear - 0.02 or self._steps > 40:
            self._enter("over")
        return self._up(self.grip, float(np.clip(clear - self._scene.hand_m[2], 0.02, 0.08)))

    def _over(self) -> np.ndarray:
        """Above the standoff, turning on the way."""
        target = self._standoff()
        target[2] = max(target[2], self._scene.clear_m)
        error = np.linalg.norm((target - self._scene.hand_m)[:2])
        if (error < 0.03 and np.linalg.norm(self._rotation_error()) < 0.15) or self._steps > 90:
            self._enter("near")
        return self._toward(target, self.grip)

    def _near(self) -> np.ndarray:
        target = self._standoff()
        if np.linalg.norm(target - self._scene.hand_m) < 0.012 or self._steps > 50:
            self._enter("reach")
        return self._toward(target, self.grip)

    def _reach(self) -> np.ndarray:
        target = self._contact()
        if np.linalg.norm(target - self._scene.hand_m) < 0.007 or self._steps > 30:
            self._enter("grip" if self.grip == OPEN else "move")
        return self._toward(target, self.grip, gain=1.0)

    def _grip(self) -> np.ndarray:
        if self._steps > 9:
            self._held_at = self._scene.hand_m
            self._enter("move")
        return self._toward(self._contact(), CLOSED, gain=1.0)

    @abstractmethod
    def _move(self) -> np.ndarray:
        """Moves the joint."""

    def _ends(self, lost: bool, limit: int) -> bool:
        """Whether the work ends here: reached, out of hand, let go too early, or taking too long."""
        early = 0 < self._flaws.drop_after < self._steps
        if self._scene.reached(self.goal) or lost or early or self._steps > limit:
            self._enter("leave")
            return True
        return False

    def _leave(self) -> np.ndarray:
        """Lets go and backs off."""
        if self._steps > 16:
            self._end_or(self._start)
        if self._steps < 5:
            return self._toward(self._scene.hand_m, OPEN, turn=False)
        return self._toward(self._scene.hand_m - 0.05 * self._scene.hand_rotation[:, 2], OPEN, turn=False)


class DrawerPull(JointMotion):
    """Opens a drawer: grasps the handle from in front and above, and pulls."""

    def _plan(self) -> None:
        out = self._joint.opening
        self._pointing = np.cos(_PULL_TILT_RAD) * _DOWN - np.sin(_PULL_TILT_RAD) * out
        closing = np.cos(_PULL_TILT_RAD) * out + np.sin(_PULL_TILT_RAD) * _DOWN
        turned = Rotation.from_rotvec(self._flaws.turn_rad * self._pointing).apply(closing)
        self._grip_rotation = self._rotation_along(self._pointing, turned)

    def _contact(self) -> np.ndarray:
        return self._joint.handle_m + self._aim + 0.003 * (self._tries % 3) * self._pointing

    def _standoff(self) -> np.ndarray:
        return self._contact() - 0.09 * self._pointing

    def _move(self) -> np.ndarray:
        slip = np.linalg.norm(self._scene.hand_m - self._joint.handle_m)
        self._ends(bool(slip > 0.04), 80)
        target = self._joint.handle_m + 0.07 * self._joint.opening
        return self._toward(target, CLOSED, gain=1.0)


class DrawerPush(JointMotion):
    """Closes a drawer: closed fingers push its handle."""

    grip = CLOSED

    def _plan(self) -> None:
        out = self._joint.opening
        self._pointing = np.cos(_PUSH_TILT_RAD) * _DOWN - np.sin(_PUSH_TILT_RAD) * out
        self._grip_rotation = self._rotation_along(self._pointing, np.cross(out, _UP))

    def _contact(self) -> np.ndarray:
        return self._joint.handle_m + self._aim + 0.03 * self._joint.opening + 0.01 * _UP

    def _standoff(self) -> np.ndarray:
        return self._contact() + 0.03 * self._joint.opening + 0.04 * _UP

    def _move(self) -> np.ndarray:
        self._ends(False, 80)
        return self._toward(self._contact() - 0.07 * self._joint.opening, CLOSED, gain=1.0)


class KnobTurn(JointMotion):
    """Turns a knob: grasps its ridge from above and turns the hand."""

    def _plan(self) -> None:
        ridge = self._joint.ridge_axis
        closing = np.cross(_UP, ridge)
        turned = Rotation.from_rotvec(self._flaws.turn_rad * _UP).apply(closing)
        self._grip_rotation = self._rotation_along(_DOWN, turned)

    def _contact(self) -> np.ndarray:
        point = self._joint.anchor_m.copy()
        point[2] = self._joint.top_m - 0.018
        return point + self._aim

    def _standoff(self) -> np.ndarray:
        return self._contact() + 0.08 * _UP

    def _move(self) -> np.ndarray:
        self._ends(False, 60)
        sign = -1.0 if self.goal.predicate[0] == "turnoff" else 1.0
        action = self._toward(self._contact(), CLOSED, turn=False)
        action[3:6] = sign * 0.4 * self._joint.axis
        return action


class DoorPush(JointMotion):
    """Closes a hinged door: closed fingers push its outer face round the hinge."""

    grip = CLOSED

    def _plan(self) -> None:
        self._grip_rotation = self._rotation_along(_DOWN, np.array([*self._scene.closing_axis, 0.0]))

    def _face(self, off_m: float, ahead_rad: float = 0.0) -> np.ndarray:
        return self._joint.door_m(0.75, off_m, ahead_rad) + self._aim

    def _contact(self) -> np.ndarray:
        return self._face(0.03)

    def _standoff(self) -> np.ndarray:
        return self._face(0.10)

    def _move(self) -> np.ndarray:
        self._ends(False, 160)
        return self._toward(self._face(0.0, 0.25), CLOSED, gain=1.0)
