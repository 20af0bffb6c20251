"""What six directions and a gripper mean in each platform's own action space.

Directions are those of the robot: forward is away from its base, left is its left. Nothing is scaled here: 1
is the largest value that the platform's normalised action space has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import ScenarioError

AXES = ("forward", "left", "up", "roll", "pitch", "yaw")

GRIPPER_SECONDS = 0.5
"""Simulated time that passes by itself once the gripper was commanded to open or close."""


@dataclass(frozen=True)
class Controls:
    """Action conventions of a platform."""

    platform: str
    width: int
    """Values in an action."""
    columns: Mapping[str, tuple[int, float]]
    """Columns by axis: the action's column, and the sign of the axis there."""
    gripper: tuple[int, float, float] | None = None
    """The action's column, and its value to open and to close."""
    captions: Mapping[str, str] = field(default_factory=dict)
    """What a person should know of a camera, by LeRobot's name of it."""
    live_options: Mapping[str, Any] = field(default_factory=dict)
    """Of the simulator, for pictures that only the controller looks at: cheap ones."""

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
