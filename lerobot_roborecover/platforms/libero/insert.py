"""A scripted controller for what belongs behind a door: brings it in from the front, the hand leaning in."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.libero.motion import CLOSED, OPEN
from lerobot_roborecover.platforms.libero.pick_place import PickPlace
from lerobot_roborecover.platforms.libero.scene import Goal, LiberoScene

_LEAN_RAD = 0.45
"""From straight down, so that the palm stays before the ceiling."""
_BEFORE_M = 0.13
"""From the object's place to where it waits outside."""
_SHORT_M = 0.04
"""The object stays so far before the region's middle, where the hand can still bring it."""

_SILL_M = 0.1
"""Nearer than this to the region's middle, what stands on its floor is pushed in by the closing door."""


def on_sill(scene: LiberoScene, goal: Goal) -> bool:
    """Whether an object stands far enough inside for the door to push it in."""
    door = scene.door(goal.region)
    if door is None or scene.holds(goal.item):
        return False
    off = scene.position_m(goal.item) - scene.center_m(goal.region)
    foot = float(scene.cloud_m(goal.item)[:, 2].min())
    inside = scene.support_m(scene.center_m(goal.region), ignore=goal.item)
    return bool(np.linalg.norm(off[:2]) < _SILL_M and abs(foot - inside) < 0.015)


class PlaceInside(PickPlace):
    """Takes an object by its rim on the side of the opening, and places it through that."""

    @property
    def _out(self) -> np.ndarray:
        """(2,) unit vector out of the opening."""
        door = self._scene.door(self.goal.region)
        if door is None:
            raise ValueError(f"{self.goal.region} has no door")
        return door.outward[:2]

    def _plan(self) -> None:
        super()._plan()
        self._grip_rotation = self._lean(self._grip_rotation)

    def _choose(self) -> None:
        super()._choose()
        self.done = self.done or on_sill(self._scene, self.goal)

    def _preference(self, axis: np.ndarray) -> float:
        return 3.0 * float(axis @ self._out)

    def _lean(self, down: np.ndarray) -> np.ndarray:
        """A hand that points down, leaned into the opening."""
        turn = np.cross([0.0, 0.0, -1.0], [*-self._out, 0.0])
        return Rotation.from_rotvec(_LEAN_RAD * turn).as_matrix() @ down

    def _goal_xy(self) -> np.ndarray:
        return super()._goal_xy() + _SHORT_M * self._out

    def _floor_m(self) -> float:
        """Height of what the object is to stand on."""
        inside = np.array([*self._goal_xy(), float(self._scene.center_m(self.goal.region)[2])])
        return self._scene.support_m(inside, ignore=self.goal.item)

    def _clear(self) -> float:
        return self._floor_m() + 0.012

    def _carry(self) -> np.ndarray:
        """To before the opening, at the height of its floor, then in."""
        if self._lost():
            return self._retry()
        hand, here = self._scene.hand_m, self._carried_xy()
        way = self._goal_xy() - here
        aside = way - (way @ self._out) * self._out
        rise = self._clear() - self._item_bottom()
        ready = np.linalg.norm(aside) < 0.015 and abs(rise) < 0.012
        if not ready:
            depth = -way @ self._out
            way = (
                aside
                + (max(_BEFORE_M - depth, 0.0) if np.linalg.norm(aside) > 0.03 or depth < 0.1 else 0.0)
                * self._out
            )
        way *= min(1.0, 0.03 / max(float(np.linalg.norm(way)), 1e-6))
        if (ready and -(self._goal_xy() - here) @ self._out < 0.01) or self._steps > 80:
            self._enter("lower")
        return self._toward(np.array([*(hand[:2] + way), hand[2] + rise]), CLOSED, gain=1.2)

    def _retreat(self) -> np.ndarray:
        """Back along the hand, out of the opening, then up."""
        if self._steps > 26:
            self._tries += 1
            self._choose()
        back = -0.05 * self._scene.hand_rotation[:, 2]
        if self._steps > 10:
            back = 0.05 * np.array([*self._out, 0.8])
        return self._toward(self._scene.hand_m + back, OPEN, turn=False)
