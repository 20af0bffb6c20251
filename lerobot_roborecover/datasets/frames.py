"""The last frames before the handoff, losslessly: what a replay's pictures are compared with."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.simulator import iter_steps
from lerobot_roborecover.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.simulator import Observation, Simulator

KEPT = 5
"""Frames a camera (paper, "Replay-Based Data Checking": the mean SSIM of the final five)."""


@dataclass(frozen=True)
class LastFrames:
    """What a scenario's cameras saw last before the policy takes over."""

    scenario_id: str
    sha256: str
    """`Scenario.sha256()` of the scenario that was replayed."""
    step: int
    """Prefix actions before the last frame: the recovery point. The others precede it step by step."""
    png: Mapping[str, tuple[bytes, ...]]
    """By LeRobot's feature name of the camera: up to five PNG pictures, oldest first, upright."""

    def arrays(self) -> dict[str, np.ndarray]:
        """(K, H, W, 3) uint8 by camera."""
        return {
            camera: np.stack([decode_png(data) for data in frames]) for camera, frames in self.png.items()
        }


class Tail:
    """Keeps the last pictures of a replay."""

    def __init__(self, platform: str):
        self._platform = platform
        self._seen: deque[dict[str, np.ndarray]] = deque(maxlen=KEPT)

    def add(self, observation: Observation) -> None:
        """Takes an observation's pictures; those of five steps ago go."""
        self._seen.append(camera_pictures(self._platform, observation))

    def frames(self, scenario: Scenario) -> LastFrames:
        """What was seen, when the recovery point is reached."""
        png = {camera: tuple(encode_png(p[camera]) for p in self._seen) for camera in self._seen[-1]}
        return LastFrames(scenario.id, scenario.sha256(), len(scenario.prefix), png)


def last_frames(simulator: Simulator, scenario: Scenario) -> LastFrames:
    """Replays a scenario and looks at the last five states, the recovery point being the fifth.

    Args:
        simulator: of the scenario's platform, with pictures among its observations.
        scenario: what to replay; the simulator is left at its recovery point.
    """
    tail = Tail(scenario.platform)
    for step in iter_steps(simulator, scenario.rollout):
        if step > len(scenario.prefix) - KEPT:
            tail.add(simulator.observe())
    return tail.frames(scenario)


def camera_pictures(platform: str, observation: Observation) -> dict[str, np.ndarray]:
    """An observation's pictures as policies see them, without LeRobot: (H, W, 3) uint8 by feature name."""
    pixels = observation.get("pixels", {})
    if not isinstance(pixels, Mapping):
        return {"observation.image": np.array(pixels)}
    upright = platform_named(platform).upright
    return {f"observation.images.{name}": np.array(upright(p)) for name, p in pixels.items()}


def encode_png(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) uint8 as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def decode_png(data: bytes) -> np.ndarray:
    """(H, W, 3) uint8 of a stored picture.

    Raises:
        ScenarioError: it is no whole PNG.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as err:
        raise ScenarioError(
            f"a stored frame is not a whole PNG ({err}); fetch or render the dataset again"
        ) from None
