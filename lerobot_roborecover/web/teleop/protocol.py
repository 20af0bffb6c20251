"""What page and server say to each other over one websocket.

Text messages are JSON objects. The server's pictures are binary: one byte camera, three bytes zero, four
bytes step (little-endian), then a JPEG.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

from lerobot_roborecover.platforms.controls import AXES
from lerobot_roborecover.scenario import ScenarioError

VERSION = 1
MAX_ACTIONS = 256
"""Actions in one `act`."""
MAX_BACK = 20_000
MAX_TEXT = 200
COMMANDS = (
    "start", "preview", "act", "back", "mark", "relabel", "unmark", "finish", "discard", "gripper",
    "realtime", "status", "hand_back",
)  # fmt: skip
"""Commands; each is answered, and only accepted from the controller."""
_HEADER = struct.Struct("<BxxxI")


def parse(text: str) -> dict[str, Any]:
    """A message to the server.

    Raises:
        ScenarioError: it is none.
    """
    try:
        sent = json.loads(text)
    except (ValueError, RecursionError):
        raise ScenarioError("the message is not JSON") from None
    if not isinstance(sent, dict) or not isinstance(sent.get("type"), str):
        raise ScenarioError("the message is not a JSON object with a type")
    known = (*COMMANDS, "hold", "seen", "drive")
    if sent["type"] not in known:
        raise ScenarioError(f"message type {sent['type']!r:.40} is not one of {', '.join(known)}")
    return sent


def held_axes(sent: dict[str, Any]) -> tuple[float, ...]:
    """The axes of a `hold`.

    Raises:
        ScenarioError: they are not six numbers from -1 to 1.
    """
    axes = sent.get("axes")
    numbers = isinstance(axes, list) and len(axes) == len(AXES) and all(_is_number(v) for v in axes)
    if not numbers or any(not abs(v) <= 1 for v in axes):
        raise ScenarioError(f"axes must be {len(AXES)} finite numbers from -1 to 1; got {axes!r:.80}")
    return tuple(float(v) for v in axes)


def whole_number(sent: dict[str, Any], name: str, low: int, high: int, default: int | None = None) -> int:
    """A count in a message.

    Raises:
        ScenarioError: it is none, or out of range.
    """
    value = sent.get(name, default)
    if type(value) is not int or not low <= value <= high:
        raise ScenarioError(f"{name} must be a whole number from {low} to {high}; got {value!r:.40}")
    return value


def plain_text(sent: dict[str, Any], name: str) -> str:
    """A short text in a message; empty where it is missing.

    Raises:
        ScenarioError: it is no text, or too long.
    """
    value = sent.get(name, "")
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise ScenarioError(f"{name} must be text of at most {MAX_TEXT} characters")
    return value


def picture(camera: int, step: int, jpeg: bytes) -> bytes:
    return _HEADER.pack(camera, step) + jpeg


def read_picture(data: bytes) -> tuple[int, int, bytes]:
    """Camera, step and JPEG of a picture that was sent."""
    camera, step = _HEADER.unpack_from(data)
    return camera, step, data[_HEADER.size :]


def _is_number(value: object) -> bool:
    # `isfinite` fails on an integer that no float holds.
    return type(value) is int or (isinstance(value, float) and math.isfinite(value))
