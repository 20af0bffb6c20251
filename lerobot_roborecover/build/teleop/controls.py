"""What six directions and a gripper mean in each platform's own action space.

Directions are those of the robot: forward is away from its base, left is its left. Nothing is scaled here: 1
is the largest value that the platform's normalised action space has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.scenario import ScenarioError

AXES = ("forward", "left", "up", "roll", "pitch", "yaw")

GRIPPER_SECONDS = 0.5
"""Simulated time that passes by itself once the gripper was told to open or close."""


@dataclass(frozen=True)
class Controls:
    """How a platform is driven."""

    platform: str
    width: int
    """Values in an action."""
    columns: Mapping[str, tuple[int, float]]
    """By axis: the action's column, and the sign of the axis there."""
    gripper: tuple[int, float, float] | None = None
    """The action's column, and its value to open and to close."""

    def action(self, axes: Sequence[float], closed: bool) -> np.ndarray:
        """(A,) float64.

        Args:
            axes: six values in [-1, 1], in the order of `AXES`; those that the platform lacks do nothing.
            closed: whether the gripper is to be closed.
        """
        action = np.zeros(self.width)
        for name, value in zip(AXES, axes, strict=True):
            if name in self.columns:
                column, sign = self.columns[name]
                # The sum keeps -0.0 out of the record.
                action[column] = sign * value + 0.0
        if self.gripper is not None:
            column, opened, shut = self.gripper
            action[column] = shut if closed else opened
        return action

    def closed_by(self, action: np.ndarray) -> bool:
        """Whether an action tells the gripper to close."""
        if self.gripper is None:
            return False
        column, opened, shut = self.gripper
        return bool(abs(action[column] - shut) < abs(action[column] - opened))

    def check(self, action: object) -> np.ndarray:
        """An action from outside, (A,) float64.

        Raises:
            ScenarioError: it is not one of this platform's; says which value.
        """
        try:
            values = np.array(action, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ScenarioError(f"an action is a list of {self.width} numbers; got {action!r:.80}") from None
        if values.shape != (self.width,):
            raise ScenarioError(f"an action has {self.width} numbers; got shape {values.shape}")
        bad = np.flatnonzero(~(np.abs(values) <= 1.0))
        if len(bad):
            raise ScenarioError(
                f"action value {bad[0]} is {values[bad[0]]}; it must be finite and from -1 to 1. Clip it"
            )
        return values


_CONTROLS = {
    "metaworld": Controls(
        "metaworld", 4, {"forward": (1, 1.0), "left": (0, -1.0), "up": (2, 1.0)}, (3, -1.0, 1.0)
    ),
    "libero": Controls("libero", 7, {name: (i, 1.0) for i, name in enumerate(AXES)}, (6, -1.0, 1.0)),
    "fake": Controls("fake", 2, {"forward": (1, 1.0), "left": (0, -1.0)}),
}


def controls_of(platform: str) -> Controls:
    """A platform's controls.

    Raises:
        ScenarioError: it cannot be driven by hand.
    """
    if platform == "robotwin":
        raise ScenarioError(
            "RoboTwin cannot be driven by hand: an action is 14 absolute joint targets, or absolute poses "
            "through a motion planner, and takes 50 to 750 physics steps, so that there is no small motion "
            "that a key could stand for. Take rollouts of policies or of its scripted expert instead"
        )
    if platform not in _CONTROLS:
        raise ScenarioError(f"platform {platform!r:.40} is not one of {', '.join(sorted(_CONTROLS))}")
    return _CONTROLS[platform]
