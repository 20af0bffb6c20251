"""A scripted controller for what is too wide to be grasped: slides a plate over the table by its rim."""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.platforms.libero.motion import CLOSED, OPEN, ClearMotion, Flaws
from lerobot_roborecover.platforms.libero.scene import Goal, LiberoScene

_DOWN = np.array([0.0, 0.0, -1.0])


class RimSlide(ClearMotion):
    """Takes the rim on the side of the goal between the fingers, and slides it there.

    Args:
        scene: of the simulator's current reset.
        goal: what belongs where.
        flaws: errors to make.
    """

    def __init__(self, scene: LiberoScene, goal: Goal, flaws: Flaws | None = None):
        super().__init__(scene, goal, flaws)
        self._plan()
        self._enter("release" if scene.held else "rise")

    def _plan(self) -> None:
        way = self._way()
        self._ahead = way / max(np.linalg.norm(way), 1e-6)
        turn, sine = np.cos(self._flaws.turn_rad), np.sin(self._flaws.turn_rad)
        closing = turn * self._ahead + sine * np.array([-self._ahead[1], self._ahead[0]])
        self._grip_rotation = self._rotation_along(_DOWN, np.array([*closing, 0.0]))

    def _way(self) -> np.ndarray:
        """(2,) metres that are left."""
        goal = self._scene.center_m(self._flaws.region or self.goal.region)[:2] + self._flaws.place_m
        return goal - self._scene.position_m(self.goal.item)[:2]

    def _rim(self) -> np.ndarray:
        """(3,) metres: where the rim is taken."""
        cloud = self._scene.cloud_m(self.goal.item)
        low, high = cloud.min(0), cloud.max(0)
        radius = (high - low)[:2].min() / 2 - 0.004 * (1 + self._tries % 3)
        point = (low + high)[:2] / 2 + radius * self._ahead
        return np.array([*point, low[2] + 0.014 - self._flaws.carry_m / 4]) + self._flaws.aim_m

    def _rise(self) -> np.ndarray:
        rise = self._scene.clear_m - 0.1 - self._scene.hand_m[2]
        if rise < 0.02 or self._steps > 40:
            self._enter("over")
        return self._up(OPEN, float(np.clip(rise, 0.0, 0.08)))

    def _over(self) -> np.ndarray:
        target = self._rim() + np.array([0.0, 0.0, 0.1])
        near = np.linalg.norm((target - self._scene.hand_m)[:2]) < 0.01
        if (near and np.linalg.norm(self._rotation_error()) < 0.1) or self._steps > 80:
            self._enter("down")
        return self._toward(target, OPEN)

    def _down(self) -> np.ndarray:
        target = self._rim()
        if self._scene.hand_m[2] - target[2] < 0.006 or self._steps > 30:
            self._enter("grip")
        return self._toward(target, OPEN)

    def _grip(self) -> np.ndarray:
        if self._steps > 9:
            self._enter("slide")
        return self._toward(self._scene.hand_m, CLOSED, turn=False)

    def _slide(self) -> np.ndarray:
        way, hand = self._way(), self._scene.hand_m
        left = float(np.linalg.norm(way))
        early = 0 < self._flaws.drop_after < self._steps
        slipped = np.linalg.norm((hand - self._scene.position_m(self.goal.item))[:2]) > 0.11
        if left < 0.01 or early or slipped or self._steps > 100:
            self._enter("leave")
        return self._toward(hand + np.array([*(min(left, 0.04) / left * way), 0.0]), CLOSED, turn=False)

    def _leave(self) -> np.ndarray:
        if self._steps > 18:
            self._end_or(self._again)
        return self._up(OPEN, 0.0 if self._steps < 6 else 0.06)

    def _again(self) -> None:
        self._plan()
        self._enter("over")
