"""Finds the frames that a scenario's original showed: the rollout's video, or the dataset's lossless ones."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.candidates import CandidateSet
from lerobot_roborecover.curation.validate.frames import (
    Encoder,
    Originals,
    originals_from_video,
    read_encoders,
)
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.scenario import Scenario, ScenarioError


class OriginalFrames:
    """Original frames by scenario: of the candidate dataset's video where it has the scenario's rollout, else
    the last frames that the scenario dataset holds losslessly.

    Args:
        root: folder of the scenario dataset.
        sets: candidate datasets.
        wanted: whether frames are compared at all.
    """

    def __init__(self, root: Path, sets: Sequence[CandidateSet], wanted: bool):
        self._root, self._sets, self._wanted = root, sets, wanted
        self._videos: dict[Path, tuple[Videos, dict[str, Encoder]]] = {}

    @cached_property
    def _store(self) -> FrameStore:
        return FrameStore(self._root)

    def of(self, scenario: Scenario) -> Originals | None:
        """The frames of a scenario; None where none are compared.

        Raises:
            ScenarioError: there are none.
        """
        if not self._wanted:
            return None
        for found in self._sets:
            episode = found.by_id.get(scenario.id)
            if episode is not None:
                videos, encoders = self._video_of(found)
                return originals_from_video(videos, encoders, episode, len(scenario.prefix))
        pictures = self._lossless(scenario).arrays()
        return Originals(pictures, "lossless, of the scenario dataset", {})

    def _lossless(self, scenario: Scenario) -> LastFrames:
        if scenario.id not in self._store:
            raise ScenarioError(
                f"scenario {scenario.id} has no original frames: {self._root} holds none, and no "
                "--candidates dataset has its rollout. Name the candidate dataset that it was made from, or "
                "go without: --no-frames"
            )
        return self._store.of(scenario)

    def identity(self, scenario: Scenario) -> str:
        """Tells apart frames that are not the same, without decoding them.

        Raises:
            ScenarioError: there are none.
        """
        if not self._wanted:
            return ""
        for found in self._sets:
            episode = found.by_id.get(scenario.id)
            if episode is not None:
                stats = [p.stat() for p in sorted((found.root / "videos").rglob("*.mp4"))]
                return f"video {episode} {[(s.st_size, s.st_mtime_ns) for s in stats]}"
        digest = hashlib.sha256()
        for camera, frames in sorted(self._lossless(scenario).png.items()):
            digest.update(camera.encode())
            for data in frames:
                digest.update(data)
        return f"lossless {digest.hexdigest()}"

    def size(self) -> tuple[int, int] | None:
        """Height and width of the frames, where all cameras share one."""
        shapes = set()
        for found in self._sets:
            videos, _ = self._video_of(found)
            shapes |= {videos.decode(camera, 0, 0, 1)[0].shape[:2] for camera in videos.cameras}
        if not self._sets and len(self._store):
            first = next(iter(self._store.values()))
            shapes = {p.shape[1:3] for p in first.arrays().values()}
        return shapes.pop() if len(shapes) == 1 else None

    def _video_of(self, found: CandidateSet) -> tuple[Videos, dict[str, Encoder]]:
        if found.root not in self._videos:
            self._videos[found.root] = Videos(found.root), read_encoders(found.root)
        return self._videos[found.root]
