"""What every scripted controller of LIBERO's arm is made of: flaws, phases, and commands towards a pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.libero.scene import Goal, LiberoScene

OPEN, CLOSED = -1.0, 1.0
"""Commands of the gripper."""
_STEP_M, _STEP_RAD = 0.05, 0.5
"""What a full translation or rotation command asks for (robosuite's OSC_POSE)."""


@dataclass(frozen=True)
class Flaws:
    """Flaws of a weaker controller; all off for the expert."""

    aim_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant error of the grasp, in the world."""
    turn_rad: float = 0.0
    """Constant error of the closing direction, about the vertical."""
    item: str = ""
    """Grasps this object whatever the goal says."""
    region: str = ""
    """Brings the object here whatever the goal says."""
    place_m: tuple[float, float] = (0.0, 0.0)
    """Constant error of the place where the object is put down."""
    carry_m: float = 0.0
    """Constant error of the transport's height."""
    drop_after: int = 0
    """Opens the gripper this many steps into the transport; 0 never does."""
    open_loop: bool = False
    """Plans once, never looks whether it holds anything, and rests after one attempt."""


class ArmMotion:
    """A controller of the arm in phases: `act` calls the method named after the phase.

    Args:
        scene: of the simulator's current reset.
        flaws: errors to make.
    """

    def __init__(self, scene: LiberoScene, flaws: Flaws | None = None):
        self._scene, self._flaws = scene, flaws or Flaws()
        self._tries = 0
        self._grip_rotation = scene.hand_rotation
        """(3, 3) that the hand turns to."""
        self._straight = 0
        """Steps for which the elbow has been straight."""
        self.done = False
        """Whether it has nothing left to do."""

    def act(self) -> np.ndarray:
        """The next (7,) float64 relative OSC action."""
        self._steps += 1
        action = getattr(self, f"_{self.phase}")()
        return np.clip(action, -1.0, 1.0)

    def _enter(self, phase: str) -> None:
        self.phase, self._steps = phase, 0

    def _rest(self) -> np.ndarray:
        """Waits, as a controller that believes it is done."""
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, OPEN])

    def _rotation_error(self) -> np.ndarray:
        return Rotation.from_matrix(self._grip_rotation @ self._scene.hand_rotation.T).as_rotvec()

    def _toward(self, target_m: np.ndarray, grip: float, gain: float = 1.6, turn: bool = True) -> np.ndarray:
        action = np.zeros(7)
        action[:3] = (target_m - self._scene.hand_m) / _STEP_M * gain
        if turn:
            action[3:6] = np.clip(self._rotation_error() / _STEP_RAD * 1.5, -0.6, 0.6)
            self._straight = self._straight + 1 if self._scene.stretched else 0
            if not self._flaws.open_loop and self._straight > 20:
                # Turning a hand at the end of a straight arm only holds the elbow straight. Not quite zero:
                # then the controller would go on with the turn before.
                action[3:6] *= 1e-3
        action[6] = grip
        return action

    def _up(self, grip: float, rise_m: float) -> np.ndarray:
        return self._toward(self._scene.hand_m + np.array([0.0, 0.0, rise_m]), grip, turn=False)

    def _rotation_along(self, pointing: np.ndarray, closing: np.ndarray) -> np.ndarray:
        """(3, 3) hand rotation that points one way and closes along ±another, whichever is nearer.

        Args:
            pointing: (3,) unit vector.
            closing: (3,) unit vector, at right angles to it.
        """
        if closing @ self._scene.hand_rotation[:, 0] < 0:
            closing = -closing
        return np.stack([closing, np.cross(pointing, closing), pointing], axis=1)


class ClearMotion(ArmMotion):
    """A controller that begins with an empty hand above everything, and lets go at the end.

    Args:
        scene: of the simulator's current reset.
        goal: to be reached.
        flaws: errors to make.
    """

    def __init__(self, scene: LiberoScene, goal: Goal, flaws: Flaws | None = None):
        super().__init__(scene, flaws)
        self.goal = goal

    def _release(self) -> np.ndarray:
        """Lets go of whatever is in the hand, then backs off."""
        if self._steps > 14:
            self._enter("rise")
        return self._up(OPEN, 0.0 if self._steps < 6 else 0.06)

    def _end_or(self, again: Callable[[], None]) -> None:
        """Rests after the one attempt of a controller that does not look, ends where the goal is reached, or
        tries again."""
        if self._flaws.open_loop:
            self._enter("rest")
        elif self._scene.reached(self.goal):
            self.done = True
        else:
            self._tries += 1
            again()
