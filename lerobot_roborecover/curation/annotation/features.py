"""Features that an automatic annotator has read: the numbers on the page at the frames it visited."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

HAND = "hand"
"""Row of the readout with the end effector's speed and the commanded gripper."""
LOOK_S = 0.125
"""From one look to the next: ten frames of Meta-World, two of LIBERO."""


def frames_to_look_at(first_look: float, fps: float, last: int) -> list[int]:
    """Frames of an episode at which an annotator looks, the last among them; by the clock, whatever the rate.

    Args:
        first_look: as `LabelerThresholds.first_look`.
        fps: frames a second.
        last: number of the last frame.
    """
    every = max(round(LOOK_S * fps), 1)
    return sorted({*range(round(first_look * every), last + 1, every), last})


@dataclass(frozen=True)
class EpisodeInfo:
    """Facts about a whole episode, as the page shows them."""

    candidate: str
    instruction: str
    last: int
    """Number of the last frame."""
    fps: float
    solved: bool
    """At the last frame."""
    human: bool
    """A person caused the deviation and corrected it."""
    gripper_commands: tuple[float, float] = (-1.0, 1.0)
    """Values of a gripper's command that open and close it."""


type Reading = Mapping[str, Mapping[str, float]]
"""Numbers of one frame: by row (`HAND` or an object), by value (`speed`, `reach`, `goal`, ...)."""


@dataclass
class EpisodeFeatures:
    """An episode as far as it has been looked at."""

    sheet: EpisodeInfo
    readings: dict[int, Reading] = field(default_factory=dict)
    """Readings by frame."""

    def frames(self) -> np.ndarray:
        """(n,) frames looked at, in order."""
        return np.array(sorted(self.readings), dtype=int)

    def seconds(self) -> np.ndarray:
        """(n,) their times."""
        return self.frames() / self.sheet.fps

    def objects(self) -> list[str]:
        """Objects in the order of the page: the one with a goal comes first."""
        first = self.readings[int(self.frames()[0])]
        return [name for name in first if name != HAND]

    def values(self, row: str, value: str) -> np.ndarray | None:
        """(n,) numbers of one row, or None where the page has none."""
        found = [self.readings[int(f)].get(row, {}).get(value) for f in self.frames()]
        return None if any(v is None for v in found) else np.array(found, dtype=float)

    def grips(self) -> bool:
        """Whether a gripper is commanded at all."""
        first = self.readings[int(self.frames()[0])][HAND]
        return any(name != "speed" for name in first)

    def closed(self) -> np.ndarray:
        """(n,) bool: the gripper is commanded to close; all True where it has no command of its own."""
        first = self.readings[int(self.frames()[0])][HAND]
        names = [name for name in first if name != "speed"]
        commands = [self.values(HAND, name) for name in names]
        if not commands:
            return np.ones(len(self.readings), dtype=bool)
        opened, shut = self.sheet.gripper_commands
        return np.any([abs(c - shut) < abs(c - opened) for c in commands if c is not None], axis=0)
