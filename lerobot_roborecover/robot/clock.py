"""Time of a robot: the wall's, or that of a simulated robot, which goes on with its steps."""

from __future__ import annotations

import time
from typing import Any, Protocol


class Clock(Protocol):
    """Monotonic seconds, and a way to wait."""

    def now(self) -> float:
        """Seconds since some moment."""

    def sleep(self, seconds: float) -> None:
        """Waits."""


class WallClock:
    """The machine's own monotonic clock."""

    def now(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)


class SteppedClock:
    """Time that goes on only when it is told to: a simulated robot need not wait for the wall."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(seconds, 0.0)


def clock_of(robot: Any) -> Clock:
    """A robot's clock; the wall's where it has none of its own."""
    return getattr(robot, "clock", None) or WallClock()
