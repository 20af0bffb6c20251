"""Checks that a dataset's videos have one frame per step and camera, on LeRobot's timestamps.

An encoder that cannot keep up may drop frames. A reader that seeks by time then silently gets the next
episode's first frame as the last frame of this episode. A dataset that fails this check is not written, read,
validated or published. Nothing is decoded: counting takes microseconds a frame, and nothing at all where the
file's header has the count. LeRobot is not imported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets.files import load_json, read_bytes
from lerobot_roborecover.datasets.parquet_read import episodes_of
from lerobot_roborecover.scenario import ScenarioError

MAX_INFO_BYTES = 2**24
MAX_FILM_S = 1e7
REMEDY = (
    "a video with frames missing or too many shows the pictures of other steps. Record or render the episode "
    "again, or take it out with lerobot-edit-dataset's delete_episodes and run roborecover dataset repair"
)


@dataclass(frozen=True)
class Clip:
    """An episode's part of one camera's video."""

    episode: int
    camera: str
    path: Path
    start_s: float
    end_s: float
    steps: int
    """As LeRobot's metadata has them."""


def check_frames(root: Path, steps: Sequence[int] | None = None, *, thorough: bool = False) -> int:
    """Checks that every episode has one video frame of each camera for each step.

    Args:
        root: folder of a LeRobotDataset (v3.0); one without `meta/info.json` or videos has nothing to check.
        steps: of each episode, as its own metadata has them; LeRobot's number by default.
        thorough: look at the time of every frame, also where a file's header gives the right number.

    Returns:
        The number of frames, of all cameras together.

    Raises:
        ScenarioError: names the episode, the camera, the frames seen and the steps.
    """
    if not (root / "meta" / "info.json").is_file():
        return 0
    cameras, fps = _cameras(root)
    if not cameras:
        return 0
    clips = read_clips(root, cameras)
    episodes = {clip.episode for clip in clips}
    if steps is not None and episodes != set(range(len(steps))):
        raise ScenarioError(
            f"{root}/meta/episodes names {len(episodes)} episodes, the dataset's own metadata {len(steps)}; "
            "fetch or write the dataset again, or run roborecover dataset repair after LeRobot's tools"
        )
    total = 0
    for clip in clips:
        wanted = clip.steps if steps is None else steps[clip.episode]
        seen = count_frames(root, clip, fps, thorough)
        if seen != wanted or clip.steps != wanted:
            raise ScenarioError(
                f"{root}: episode {clip.episode}, camera {clip.camera}: {seen} video frames for {wanted} "
                f"steps" + ("" if clip.steps == wanted else f" (LeRobot has {clip.steps})") + f"; {REMEDY}"
            )
        total += seen
    return total


def _cameras(root: Path) -> tuple[list[str], float]:
    path = root / "meta" / "info.json"
    try:
        info = load_json(read_bytes(root, path, MAX_INFO_BYTES))
        cameras = sorted(k for k, f in info["features"].items() if f["dtype"] == "video")
        fps = float(info["fps"])
        if not 0 < fps <= 1000:
            raise ValueError(f"fps {fps}")
    except ScenarioError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        raise ScenarioError(f"{path} is not LeRobot's ({err!r:.200}); fetch the dataset again") from None
    for camera in cameras:
        if "/" in camera or ".." in camera:
            raise ScenarioError(f"{path}: camera {camera!r:.80} is not a plain name; fetch the dataset again")
    return cameras, fps


def read_clips(root: Path, cameras: Sequence[str]) -> list[Clip]:
    """Every episode's part of every camera's video, by LeRobot's metadata.

    Raises:
        ScenarioError: the metadata is not LeRobot's.
    """
    parts = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    columns = [f"videos/{camera}/{part}" for camera in cameras for part in parts]
    clips = []
    for path, table in episodes_of(root, ["episode_index", "length", *columns]):
        try:
            for row, episode in enumerate(table["episode_index"].tolist()):
                for camera in cameras:
                    chunk, file, start, end = (table[f"videos/{camera}/{part}"][row] for part in parts)
                    name = f"chunk-{int(chunk):03d}/file-{int(file):03d}.mp4"
                    video = root / "videos" / camera / name
                    steps = int(table["length"][row])
                    if not (0 <= float(start) <= float(end) < MAX_FILM_S and steps >= 0):
                        raise ValueError(f"episode {episode}: from {start} to {end} s, {steps} steps")
                    clips.append(Clip(int(episode), camera, video, float(start), float(end), steps))
        except (OverflowError, ValueError) as err:
            raise ScenarioError(f"{path} is not LeRobot's ({err!s:.200}); fetch it again") from None
    return clips


def count_frames(root: Path, clip: Clip, fps: float, thorough: bool = False) -> int:
    """The frames of an episode in one camera's video: one for each step that has one in its place."""
    try:
        real = clip.path.resolve(strict=True)
        status = real.stat()
    except (OSError, RuntimeError) as err:
        raise ScenarioError(
            f"{root}: episode {clip.episode}, camera {clip.camera}: its video {clip.path} is missing "
            f"({err}); fetch the dataset again"
        ) from None
    regular, numbers = _frames_of(str(real), fps, status.st_size, status.st_mtime_ns, thorough)
    first, last = round(clip.start_s * fps), round(clip.end_s * fps)
    if regular:
        return max(min(last, int(numbers[0])) - first, 0)
    return int(np.searchsorted(numbers, last) - np.searchsorted(numbers, first))


@lru_cache(maxsize=256)
def _frames_of(path: str, fps: float, size: int, mtime_ns: int, thorough: bool) -> tuple[bool, np.ndarray]:
    """Which places of the grid of times have a frame: all of the first N (True, [N]), or these, sorted.

    A file that has changed has another size or time, and is looked at again.
    """
    import av

    try:
        with av.open(path) as container:
            stream = container.streams.video[0]
            base = stream.time_base
            if base is None:
                raise ValueError("its video has no time base")
            if not thorough and stream.frames and stream.duration is not None:
                places = float(stream.duration * base) * fps
                # As many frames as the video is long, which `mp4` says of itself.
                if abs(places - stream.frames) < 0.01:
                    return True, np.array([stream.frames])
            times = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
            places = np.array(times, dtype=np.float64) * float(base) * fps
    except (av.FFmpegError, IndexError, TypeError, ValueError) as err:
        raise ScenarioError(
            f"{path} cannot be read as a video: {err!s:.200}. Fetch the dataset again"
        ) from None
    return False, np.unique(np.rint(places).astype(np.int64))
