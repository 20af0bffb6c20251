"""What a robot can reach, platform by platform: optional beside the `Simulator` protocol.

A simulator that knows its limits has three more methods, which change nothing in it:

- `reachable(action)`: the platform's own answer to whether it can do what an action asks for;
- `joint_margin_rad()`: how far the arm's joint nearest to a limit is from it;
- `workspace()`: where hand and objects belong.

A simulator that does not know its limits lacks these methods; `limits_of` returns None for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np


@dataclass(frozen=True)
class Workspace:
    """Where things belong in the task that the simulator was last reset to; world frame, metres."""

    low_m: tuple[float, float, float]
    """Lowest corner of the box that the end effector works in."""
    high_m: tuple[float, float, float]
    """Its highest corner."""
    support_m: float
    """Height of the table or floor on which objects stand."""


@runtime_checkable
class Limits(Protocol):
    """The optional methods."""

    def reachable(self, action: np.ndarray) -> bool:
        """Whether the robot can go where the action would send it from here."""

    def joint_margin_rad(self) -> float:
        """Distance of the arm's joints from their limits, the smallest; negative beyond; infinite where the
        robot has none."""

    def workspace(self) -> Workspace:
        """Workspace after the current reset."""


def limits_of(simulator: object) -> Limits | None:
    """The simulator's limits, or None where it knows none."""
    return simulator if isinstance(simulator, Limits) else None
