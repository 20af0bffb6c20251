"""Turns held keys, sticks and buttons into control steps, on the simulator's side.

The page repeats every held input. An input that is not repeated for `HOLD_S` is released, so that a lost
connection stops the robot. Without a held input the simulation pauses, unless real time is switched on: the
recording then does not contain the operator's pauses.
"""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.controls import AXES, GRIPPER_SECONDS

HOLD_S = 0.6
MAX_BEHIND_S = 0.25
"""How much of the time that a picture took is made up for by further steps."""
MAX_WAITING = 256
"""Commands that may wait; a person never has as many."""

_SPARE = 1.25
"""So that a picture which is a little late costs no speed."""

type Reply = Callable[[dict[str, Any]], None]


def steps_per_picture(rate_hz: float, fps: float) -> int:
    """Steps between two pictures, as real time has them."""
    return max(1, math.ceil(_SPARE * rate_hz / fps))


def most_unseen(rate_hz: float, fps: float) -> int:
    """Returns how many steps the controller may not have seen yet: those of two images, because one is on the
    screen and the next is on its way."""
    return 2 * steps_per_picture(rate_hz, fps)


@dataclass(frozen=True)
class OperatorCommand:
    """A command of the operator, other than held inputs."""

    kind: str
    values: dict[str, Any]
    reply: Reply
    """Sends the answer; callable from any thread."""


@dataclass(frozen=True)
class Tick:
    """One control step is due."""

    axes: tuple[float, ...]
    """Six values in [-1, 1]."""
    closed: bool
    device: str


@dataclass(frozen=True)
class HeldInput:
    axes: tuple[float, ...] = (0.0,) * len(AXES)
    wait: bool = False
    """Let time pass without moving."""
    until: float = 0.0

    @property
    def active(self) -> bool:
        """Whether it asks for steps."""
        return self.wait or any(self.axes)


@dataclass
class InputHandler:
    """Commands and held inputs of all devices; `poll` is for the simulator's thread, the rest for any."""

    rate_hz: float
    """Control steps a second, at most."""
    control_hz: float
    """Of the simulator."""
    closed: bool = False
    """The gripper's last command."""
    realtime: bool = False
    _queue: queue.Queue[OperatorCommand | tuple[str, HeldInput]] = field(
        default_factory=lambda: queue.Queue(MAX_WAITING)
    )
    _holds: dict[str, HeldInput] = field(default_factory=dict)
    _owed: int = 0
    """Steps for the gripper."""
    _fresh: set[str] = field(default_factory=set)
    """Devices whose hold no step was taken for yet."""
    _last: float = 0.0
    _device: str = "keyboard"

    def hold(self, device: str, axes: Sequence[float], wait: bool = False) -> None:
        """Says what a device holds now."""
        held = HeldInput(tuple(float(v) for v in axes), wait)
        try:
            self._queue.put_nowait((device, held))
        except queue.Full:
            return  # it is said again

    def command(self, command: OperatorCommand) -> None:
        """Puts a command in line; one that does not fit is refused at once."""
        try:
            self._queue.put_nowait(command)
        except queue.Full:
            command.reply({"ok": False, "message": "the simulator does not keep up; wait a moment"})

    def let_go(self) -> None:
        """Forgets what is held and owed; the simulator's thread alone."""
        self._holds.clear()
        self._fresh.clear()
        self._owed = 0
        self.realtime = False

    def toggle_gripper(self) -> None:
        """Opens or closes; time passes for it. The simulator's thread alone."""
        self.closed = not self.closed
        self._owed = max(self._owed, round(GRIPPER_SECONDS * self.control_hz))

    def poll(
        self, timeout_s: float, drive: bool = True, paused: bool = False
    ) -> OperatorCommand | Tick | None:
        """What is to be done next.

        Args:
            timeout_s: how long to wait for something.
            drive: whether steps may be taken at all.
            paused: no step is due, whatever is held; a tap that ends meanwhile still gets its step.

        Returns:
            A command, a control step that is due, or None where there is neither in time.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            due = self._due(now) if drive and not paused else None
            left = max(0.0, min(deadline, deadline if due is None else due) - now)
            try:
                item = self._queue.get(timeout=left) if left else self._queue.get_nowait()
            except queue.Empty:
                if due is not None and time.monotonic() >= due:
                    return self._tick(due)
                if time.monotonic() >= deadline:
                    return None
                continue
            if isinstance(item, OperatorCommand):
                return item
            if not drive:
                continue  # what is held is said again once it counts
            device, held = item
            # However briefly something was pressed: it gets a step before what comes after it.
            tick = self._tick(now) if device in self._fresh else None
            before = self._holds.get(device)
            # From now on, not from when it was said: a slow picture is no reason to let go.
            self._holds[device] = replace(held, until=time.monotonic() + HOLD_S)
            if held.active:
                self._device = device
                if before is None or not before.active:
                    self._fresh.add(device)
            if tick is not None:
                return tick

    def _due(self, now: float) -> float | None:
        """When the next step is due; None while time stands still."""
        kept = ((d, h) for d, h in self._holds.items() if h.until > now or d in self._fresh)
        self._holds = {d: h for d, h in kept if h.active}
        if not (self._holds or self._owed or self.realtime):
            self._last = 0.0
            return None
        # Time lost to a picture is made up for, up to a limit; time that stood still is not.
        return max(self._last + 1 / self.rate_hz, now - MAX_BEHIND_S) if self._last else now

    def _tick(self, due: float) -> Tick:
        self._last = due
        self._fresh.clear()
        self._owed = max(self._owed - 1, 0)
        total = np.clip(np.sum([h.axes for h in self._holds.values()] or [(0.0,) * 6], axis=0), -1.0, 1.0)
        return Tick(tuple(float(v) for v in total), self.closed, self._device)
