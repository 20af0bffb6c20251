"""Records videos of as many trials as requested; other trials render no frames."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import av
import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.work_items import WorkItem
from lerobot_roborecover.scenario import Outcome, Start

KINDS = ("failures", "successes", "all", "sample")
_DEFAULT = 4
_NAME = re.compile(r"(?P<id>.+?)(_(?P<start>initial|reversion))?_trial(?P<trial>\d+)_[a-z_]+")


def default_videos(options: RecoveryOptions) -> int:
    """Returns the number of videos that a run keeps when nothing says how many: some where the environment
    renders images, or is told to render them for videos."""
    return _DEFAULT if options.videos or getattr(options, "obs_type", "") != "state" else 0


def video_trial(path: Path, start: Start) -> tuple[str, int] | None:
    """Scenario and trial number of a video; None where it is of no trial from that start."""
    match = _NAME.fullmatch(path.stem)
    if match is None or (match["start"] or Start.RECOVERY) != start:
        return None
    return match["id"], int(match["trial"])


class VideoWriter:
    """An MP4 that grows with its trial, so that no video is ever in memory.

    Args:
        path: where it is written while the trial runs.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: float):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), mode="w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=round(fps))
        self._stream.pix_fmt = "yuv420p"
        self._size: tuple[int, int] | None = None

    def add(self, frames: Iterable[np.ndarray]) -> None:
        """Appends (H, W, 3) uint8 frames; an odd row or column is cut off, because yuv420p has none."""
        for frame in frames:
            if self._size is None:
                self._size = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
                self._stream.height, self._stream.width = self._size
            picture = np.ascontiguousarray(frame[: self._size[0], : self._size[1]])
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def keep(self, path: Path) -> None:
        """Ends the video and gives it its name."""
        self._container.mux(self._stream.encode())
        self._container.close()
        os.replace(self.path, path)

    def drop(self) -> None:
        """Throws the video away."""
        self._container.close()
        self.path.unlink(missing_ok=True)


class VideoRecorder:
    """Decides which trials are recorded and which videos stay.

    A trial's outcome is known at its end only, so every trial that might be wanted is recorded until there
    are enough; at most `count` videos and one per slot under way are on disk.

    Args:
        folder: where videos go; those already there count.
        count: how many to keep.
        of: `failures`, `successes`, `all`, `sample`, or comma-separated scenario ids. `sample` takes the
            first trial of scenarios spread over the run's: videos of two policies show the same scenarios.
        ids: the run's scenarios.
        start: of the run's trials. Videos of other starts in `folder` stay and do not count.

    Raises:
        OptionError: `of` names neither.
    """

    def __init__(self, folder: Path, count: int, of: str, ids: Iterable[str], start: Start = Start.RECOVERY):
        self._folder, self._count, self._of, self._start = folder, count, of, start
        known = sorted(set(ids))
        self._ids = None if of in KINDS else {name.strip() for name in of.split(",")}
        if of == "sample":
            self._ids = set(_spread(known, count))
        unknown = sorted((self._ids or set()) - set(known))
        if unknown:
            raise OptionError(
                f"--runner.videos_of={of}: {unknown[0]!r} is neither one of {list(KINDS)} nor a scenario of "
                "this run"
            )
        for part in folder.glob("*.part"):  # of a run that was killed
            part.unlink()
        self.kept = sorted(path for path in folder.glob("*.mp4") if video_trial(path, start))

    def wants(self, unit: WorkItem) -> bool:
        """Whether a trial might be kept."""
        if len(self.kept) >= self._count or (self._of == "sample" and unit.trial > 0):
            return False
        return self._ids is None or unit.scenario.id in self._ids

    def begin(self, unit: WorkItem, frame: np.ndarray, fps: float) -> VideoWriter:
        """A recording that starts with the handoff's frame."""
        recording = VideoWriter(self._folder / f"{self._stem(unit)}.part", fps)
        recording.add([frame])
        return recording

    def finish(self, recording: VideoWriter, unit: WorkItem, outcome: Outcome) -> None:
        """Keeps or drops the video of a trial that has ended."""
        success = outcome is Outcome.SUCCESS
        fits = self._of not in ("failures", "successes") or success == (self._of == "successes")
        if not fits or len(self.kept) >= self._count:
            recording.drop()
            return
        path = self._folder / f"{self._stem(unit)}_{outcome.value}.mp4"
        recording.keep(path)
        self.kept.append(path)

    def _stem(self, unit: WorkItem) -> str:
        start = "" if self._start is Start.RECOVERY else f"_{self._start.value}"
        return f"{unit.scenario.id}{start}_trial{unit.trial}"


def _spread(ids: Sequence[str], count: int) -> list[str]:
    """At most `count` of the ids, evenly spaced."""
    count = min(count, len(ids))
    return [ids[k * len(ids) // count] for k in range(count)]
