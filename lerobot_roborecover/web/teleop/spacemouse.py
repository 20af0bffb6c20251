"""A 3Dconnexion SpaceMouse, plugged into the simulator's machine, as one more device that holds axes.

Read through hidapi's own Python binding: the report format is short and stable, and the wheel brings the
library with it. Reports (little-endian, 350 is about the end of the range):

- 1: translation x (right), y (towards the user), z (down) as int16; newer models append the rotation;
- 2: rotation about the same three axes, where it comes apart;
- 3: buttons, one bit each.
"""

from __future__ import annotations

import importlib
import logging
import struct
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.web.teleop.pilot import InputHandler, OperatorCommand

_LOG = logging.getLogger(__name__)
VENDORS = (0x256F, 0x046D)
"""3Dconnexion, and Logitech, which once made them."""
_MULTI_AXIS = (1, 8)
"""HID usage page and usage of a multi-axis controller."""
_FULL = 350.0
_DEAD_ZONE = 0.05
_READ_MS = 100
_REOPEN_S = 2.0
BUTTONS = ("gripper", "mark")
"""What the first two buttons ask for."""


class Device(Protocol):
    """What is used of `hid.device`."""

    def read(self, max_length: int, timeout_ms: int) -> Sequence[int]:
        """A report's bytes, or none in time; OSError once it is unplugged."""

    def close(self) -> None:
        """Lets go of it."""


class Reports:
    """Decodes a stream of reports."""

    def __init__(self) -> None:
        self.raw = [0.0] * 6
        """Translation and rotation about the device's own axes, about -1 to 1."""
        self.buttons = 0

    def take(self, report: Sequence[int]) -> list[int]:
        """Takes one report; those of unknown kinds, and damaged ones, change nothing.

        Returns:
            Buttons that went down.
        """
        data = bytes(report)
        kind, body = data[:1], data[1:]
        if kind in (b"\x01", b"\x02") and len(body) >= 6:
            count = 6 if kind == b"\x01" and len(body) >= 12 else 3
            values = [v / _FULL for v in struct.unpack_from(f"<{count}h", body)]
            first = 0 if kind == b"\x01" else 3
            self.raw[first : first + count] = values
        elif kind == b"\x03" and body:
            now = int.from_bytes(body[:4], "little")
            pressed = [bit for bit in range(32) if now & ~self.buttons & 1 << bit]
            self.buttons = now
            return pressed
        return []

    def axes(self, speed: float) -> list[float]:
        """Six axes as `controls.AXES` has them: forward, left, up, and turns about the same.

        Args:
            speed: what the end of the range gives, up to 1.
        """
        x, y, z, about_x, about_y, about_z = self.raw
        # Right, towards the user, down is forward, left, up turned about; turns follow the same way.
        return [_shaped(-v) * speed for v in (y, x, z, about_y, about_x, about_z)]


class SpaceMouse(threading.Thread):
    """Reads a SpaceMouse for a pilot; one that is unplugged lets go, and is found again.

    Args:
        pilot: told what is held.
        speed: what the end of the range gives, up to 1.
        open_device: finds it.

    Raises:
        ScenarioError: there is none, or it may not be read.
    """

    def __init__(
        self, pilot: InputHandler, speed: float = 0.5, open_device: Callable[[], Device] | None = None
    ):
        super().__init__(name="spacemouse", daemon=True)
        self._pilot, self._speed = pilot, speed
        self._open = open_device or find_spacemouse
        self._device: Device | None = self._open()
        self._stopped = threading.Event()

    def run(self) -> None:
        reports = Reports()
        while not self._stopped.is_set():
            try:
                if self._device is None:
                    self._device = self._open()
                report = self._device.read(64, _READ_MS)
            except (OSError, ValueError) as err:
                if self._device is not None:
                    _LOG.warning("the SpaceMouse cannot be read any more (%s); plug it in again", err)
                    self._device.close()
                self._device, reports = None, Reports()
                self._pilot.hold("spacemouse", reports.axes(1.0))
                self._stopped.wait(_REOPEN_S)
                continue
            pressed = reports.take(report) if report else []
            axes = reports.axes(self._speed)
            if report or any(axes):
                self._pilot.hold("spacemouse", axes)
            for button in pressed:
                if button < len(BUTTONS):
                    self._pilot.command(OperatorCommand(BUTTONS[button], {}, _report_refusal))
        if self._device is not None:
            self._device.close()

    def stop(self) -> None:
        self._stopped.set()
        self.join()


def find_spacemouse() -> Device:
    """Opens the first SpaceMouse.

    Raises:
        ScenarioError: there is none, or it may not be read.
    """
    try:
        hid = importlib.import_module("hid")
    except ImportError as err:
        raise ScenarioError(f"a SpaceMouse needs {err.name}: {install_command('teleop')}") from None
    found = [d for d in hid.enumerate() if d["vendor_id"] in VENDORS]
    mice = [d for d in found if (d["usage_page"], d["usage"]) == _MULTI_AXIS]
    mice = mice or [d for d in found if d["vendor_id"] == VENDORS[0]]
    if not mice:
        raise ScenarioError("no SpaceMouse is plugged into this machine; leave --spacemouse out")
    device = hid.device()
    try:
        device.open_path(mice[0]["path"])
    except OSError as err:
        raise ScenarioError(
            f"{mice[0]['product_string'] or 'the SpaceMouse'} cannot be opened ({err}). On Linux its hidraw "
            "device must be readable: a udev rule for vendor 256f, or the group that owns it"
        ) from None
    return device


def _shaped(value: float) -> float:
    if abs(value) < _DEAD_ZONE:
        return 0.0
    reach = min((abs(value) - _DEAD_ZONE) / (1 - _DEAD_ZONE), 1.0)
    return reach if value > 0 else -reach


def _report_refusal(answer: dict[str, Any]) -> None:
    if not answer["ok"]:
        _LOG.warning("%s", answer["message"])
