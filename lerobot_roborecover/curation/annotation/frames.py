"""Frames of a candidate dataset's episodes as JPEG, read from its videos a few dozen at a time.

A page asks for packs of `PACK` frames: one request a second of video instead of one a frame, so that
scrubbing runs in the page's memory. Packs are kept, and those that will be asked for next are made ahead.
LeRobot is not imported: that would take a dozen seconds at every start.
"""

from __future__ import annotations

import contextlib
import io
import struct
import threading
from collections import OrderedDict, deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets.files import load_json, read_bytes
from lerobot_roborecover.datasets.parquet_read import episodes_of
from lerobot_roborecover.scenario import ScenarioError

PACK = 32
"""Frames of one camera in a pack."""
JPEG_QUALITY = 90
MAX_INFO_BYTES = 2**24
MAX_VIDEO_BYTES = 2**34
CACHE_BYTES = 2**28
MAX_AHEAD = 200
"""Packs that wait to be made."""
_HALF = 0.5


@dataclass(frozen=True)
class EpisodeSpan:
    """Where an episode lies in one camera's video."""

    path: Path
    start_s: float


class Videos:
    """The videos of a LeRobotDataset (v3.0), by camera and episode.

    Args:
        root: the dataset's folder.
        needed: refuse a dataset without any; programs that read numbers need none.

    Raises:
        ScenarioError: it is not such a dataset, or has no video and needs one.
    """

    def __init__(self, root: Path, needed: bool = True):
        self.root = root
        path = root / "meta" / "info.json"
        try:
            info = load_json(read_bytes(root, path, MAX_INFO_BYTES))
            self.fps = float(info["fps"])
            self.cameras = sorted(k for k, f in info["features"].items() if f["dtype"] == "video")
            if not 0 < self.fps <= 1000:
                raise ValueError(f"fps {self.fps}")
        except ScenarioError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
            raise ScenarioError(f"{path} is not LeRobot's ({err!r:.200}); fetch the dataset again") from None
        if not self.cameras and needed:
            raise ScenarioError(
                f"{root} has no video. Record one (collect --frames SIDE), or go without: annotate "
                "--automatic, validate --no-frames (in a build: `no_frames: true`)"
            )
        for camera in self.cameras:
            if "/" in camera or ".." in camera:
                raise ScenarioError(f"{path}: camera {camera!r:.80} is not a plain name")
        self._clips = self._read_clips()

    def _read_clips(self) -> dict[tuple[str, int], EpisodeSpan]:
        parts = ("chunk_index", "file_index", "from_timestamp")
        columns = [f"videos/{camera}/{part}" for camera in self.cameras for part in parts]
        clips = {}
        for path, table in episodes_of(self.root, ["episode_index", *columns]):
            try:
                for row, episode in enumerate(table["episode_index"].tolist()):
                    for camera in self.cameras:
                        chunk, file, start = (table[f"videos/{camera}/{part}"][row] for part in parts)
                        name = f"chunk-{int(chunk):03d}/file-{int(file):03d}.mp4"
                        clips[camera, int(episode)] = EpisodeSpan(
                            self.root / "videos" / camera / name, float(start)
                        )
            except (OverflowError, ValueError) as err:
                raise ScenarioError(f"{path} is not LeRobot's ({err!s:.200}); fetch it again") from None
        return clips

    def decode(self, camera: str, episode: int, first: int, count: int) -> list[np.ndarray]:
        """Frames first to first + count - 1 of an episode, (H, W, 3) uint8 each.

        Raises:
            ScenarioError: the video is missing, damaged, or ends before.
        """
        import av

        clip = self._clips.get((camera, episode))
        if clip is None:
            raise ScenarioError(f"{self.root} has no video of episode {episode} from {camera}")
        _check_video(self.root, clip.path)
        start = clip.start_s + first / self.fps
        frames: dict[int, np.ndarray] = {}
        try:
            with av.open(str(clip.path)) as container:
                stream = container.streams.video[0]
                if stream.time_base is None:
                    raise ValueError("the stream has no time base")
                # To the keyframe at or before the frame; half a frame of slack for rounded times.
                seek_s = max(start - _HALF / self.fps, 0.0)
                container.seek(int(seek_s / stream.time_base), stream=stream)
                for frame in container.decode(stream):
                    if frame.time is None:
                        continue
                    index = round((frame.time - clip.start_s) * self.fps)
                    if index >= first + count:
                        break
                    if index >= first:
                        frames.setdefault(index, frame.to_ndarray(format="rgb24"))
        except (av.FFmpegError, IndexError, ValueError) as err:
            raise ScenarioError(
                f"{clip.path} cannot be decoded: {err!s:.200}. Fetch the dataset again"
            ) from None
        missing = [i for i in range(first, first + count) if i not in frames]
        if missing:
            raise ScenarioError(
                f"{clip.path} has no frame {missing[0]} of episode {episode}; fetch the dataset again"
            )
        return [frames[i] for i in range(first, first + count)]


def _check_video(root: Path, path: Path) -> None:
    try:
        real = path.resolve(strict=True)
        if real.is_relative_to(root.resolve()) and real.is_file() and real.stat().st_size <= MAX_VIDEO_BYTES:
            return
    except (OSError, RuntimeError):
        pass
    raise ScenarioError(f"{path} is not a video file inside the dataset; fetch the dataset again")


def encode_pack(frames: list[np.ndarray]) -> bytes:
    """Frames as one answer: their number and sizes, little-endian uint32, then their JPEG bytes."""
    from PIL import Image

    parts = []
    for frame in frames:
        buffer = io.BytesIO()
        # Chroma at full resolution: small coloured objects are what is looked at.
        Image.fromarray(frame).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        parts.append(buffer.getvalue())
    head = struct.pack(f"<{len(parts) + 1}I", len(parts), *map(len, parts))
    return b"".join([head, *parts])


class FramePacks:
    """Packs of frames, kept up to `CACHE_BYTES`, each made once however many ask for it.

    Args:
        videos: where they come from.
        steps: number of frames by episode.
    """

    def __init__(self, videos: Videos, steps: list[int]):
        self.videos, self._steps = videos, steps
        self._lock = threading.Lock()
        self._packs: OrderedDict[tuple[str, int, int], Future[bytes]] = OrderedDict()
        self._bytes = 0
        self._ahead = ThreadPoolExecutor(1, "frames-ahead")
        self._waiting: deque[Future[None]] = deque()

    def pack(self, camera: str, episode: int, number: int) -> bytes:
        """Pack `number` of an episode: frames from `number * PACK` on.

        Raises:
            ScenarioError: see `Videos.decode`.
            IndexError: there is no such pack.
        """
        key = (camera, episode, number)
        first = number * PACK
        count = min(PACK, self._steps[episode] - first)
        if number < 0 or count <= 0:
            raise IndexError(f"this episode has no pack {number}")
        with self._lock:
            found = self._packs.get(key)
            mine = found is None
            if found is None:
                found = self._packs[key] = Future()
            self._packs.move_to_end(key)
        if mine:
            try:
                data = encode_pack(self.videos.decode(camera, episode, first, count))
            except BaseException as err:
                with self._lock:
                    del self._packs[key]
                found.set_exception(err)
                raise
            found.set_result(data)
            self._make_room(len(data))
        return found.result()

    def make_ahead(self, episode: int) -> None:
        """Makes an episode's packs in the background, if it has not been done."""
        for number in range(-(-self._steps[episode] // PACK)):
            for camera in self.videos.cameras:
                self._waiting.append(self._ahead.submit(self._quietly, camera, episode, number))
        # A user may leaf through the queue faster than packs are made: only the latest requests stay.
        while len(self._waiting) > MAX_AHEAD:
            self._waiting.popleft().cancel()

    def close(self) -> None:
        """Stops making packs."""
        self._ahead.shutdown(wait=False, cancel_futures=True)

    def _quietly(self, camera: str, episode: int, number: int) -> None:
        # The request that needs this pack raises the error again and reports it.
        with contextlib.suppress(ScenarioError):
            self.pack(camera, episode, number)

    def _make_room(self, added: int) -> None:
        with self._lock:
            self._bytes += added
            for key, future in list(self._packs.items()):
                if self._bytes <= CACHE_BYTES:
                    break
                if future.done():
                    del self._packs[key]
                    self._bytes -= len(future.result())
