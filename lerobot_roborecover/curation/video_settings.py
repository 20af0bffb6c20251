"""Render settings of a candidate's video, from its provenance. Rendering it again uses the same settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lerobot_roborecover.scenario import ScenarioError

_FOLDERS = ("assets_dir", "robotwin_root")
"""Options that name folders of one machine."""


@dataclass(frozen=True)
class VideoSettings:
    """Pictures of one rollout."""

    every: int = 1
    """Steps from one picture to the next; the last one stands until then."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the simulator that rendered."""

    def note(self) -> dict[str, Any]:
        """For the provenance, under `film`."""
        return {"every": self.every, "options": {k: v for k, v in self.options.items() if k not in _FOLDERS}}


def read_video_settings(provenance: Mapping[str, Any], where: str) -> VideoSettings:
    """Reads the render settings from a rollout's provenance; a frame at every step where it has none.

    Raises:
        ScenarioError: the note is none of `VideoSettings.note`'s.
    """
    for notes in provenance.values():
        found = notes.get("film") if isinstance(notes, Mapping) else None
        if found is None:
            continue
        every = found.get("every", 1) if isinstance(found, Mapping) else None
        if type(every) is not int or every < 1 or not isinstance(found.get("options", {}), Mapping):
            raise ScenarioError(f"{where} says it was rendered with {str(found)[:200]}; record it again")
        return VideoSettings(every, dict(found.get("options", {})))
    return VideoSettings()
