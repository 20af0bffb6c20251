"""The original's last frames, and how alike a replay's are.

Video is lossy: a frame that was rendered again differs from the decoded one far more than the paper's bound
allows (on Meta-World at 480 x 480 with LeRobot's defaults, SSIM 0.960 for the very same state). Therefore the
replay goes through the same encoder: a window of the rollout around the recovery point is replayed,
rendered, encoded with the settings that the dataset records, decoded, and only then compared. It begins on a
keyframe and goes on `TAIL` frames beyond the recovery point, because an encoder looks ahead; then an exact
replay gives the very frames of the original (SSIM 1).
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from lerobot_roborecover.curation.annotation.frames import MAX_INFO_BYTES, Videos
from lerobot_roborecover.datasets.files import load_json, read_bytes
from lerobot_roborecover.datasets.frames import KEPT
from lerobot_roborecover.scenario import ScenarioError

TAIL = 8
"""Frames beyond the recovery point that are encoded with it."""


@dataclass(frozen=True)
class Encoder:
    """Encoder settings of a camera's video."""

    codec: str
    pix_fmt: str
    options: Mapping[str, str]
    """Options of the codec."""
    fps: int
    keyframe_interval: int

    def __str__(self) -> str:
        return " ".join([self.codec, *(f"{k}={v}" for k, v in sorted(self.options.items()))])


@dataclass(frozen=True)
class Originals:
    """What the frames up to the recovery point looked like, the last at the recovery point."""

    pictures: Mapping[str, np.ndarray]
    """(K, H, W, 3) uint8 by camera."""
    how: str
    """Where they are from, for people."""
    encoders: Mapping[str, Encoder]
    """Encoders by camera, where they are from video; empty where they are lossless."""


def read_encoders(root: Path) -> dict[str, Encoder]:
    """Reads the encoder settings of a LeRobotDataset's videos, by camera.

    Raises:
        ScenarioError: the dataset does not say.
    """
    from lerobot.configs.video import encoder_config_from_video_info

    path = root / "meta" / "info.json"
    info = load_json(read_bytes(root, path, MAX_INFO_BYTES))
    found = {}
    for camera, feature in info["features"].items():
        if feature["dtype"] != "video":
            continue
        try:
            config = encoder_config_from_video_info(feature.get("info") or {})
            options = config.get_codec_options(as_strings=True)
            found[camera] = Encoder(
                config.vcodec, config.pix_fmt, {k: str(v) for k, v in options.items()}, round(info["fps"]),
                int(config.g or 1),
            )  # fmt: skip
        except (ValueError, TypeError, KeyError, AttributeError) as err:
            raise ScenarioError(
                f"{path}: camera {camera:.80} does not say how its video was encoded ({err!s:.200}); without "
                "that, lossy frames cannot be compared. Go without: --no-frames"
            ) from None
    return found


def window(step: int, steps: int, encoder: Encoder) -> range:
    """Frames to encode so that those up to `step` come out as they did in the whole episode.

    Args:
        step: the recovery point.
        steps: frames of the episode.
        encoder: its keyframes decide where to begin.
    """
    g = encoder.keyframe_interval
    first = max(step - KEPT + 1, 0) // g * g
    return range(max(first - g, 0), min(step + TAIL + 1, steps))


def originals_from_video(
    videos: Videos, encoders: Mapping[str, Encoder], episode: int, step: int
) -> Originals:
    """The frames of a rollout up to its recovery point."""
    first = max(step - KEPT + 1, 0)
    pictures = {c: np.stack(videos.decode(c, episode, first, step + 1 - first)) for c in videos.cameras}
    how = sorted({str(e) for e in encoders.values()})
    return Originals(
        pictures, f"the rollout's video, the replay encoded likewise ({', '.join(how)})", encoders
    )


def encoded(frames: Sequence[np.ndarray], encoder: Encoder) -> list[np.ndarray]:
    """Frames as they look after encoding and decoding, as LeRobot's streaming encoder does it."""
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(encoder.codec, encoder.fps, options=dict(encoder.options))
        if not isinstance(stream, av.VideoStream):
            raise ScenarioError(f"{encoder.codec} is no codec of videos")
        stream.pix_fmt = encoder.pix_fmt
        stream.height, stream.width = frames[0].shape[:2]
        stream.time_base = Fraction(1, encoder.fps)
        for number, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, encoder.fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    buffer.seek(0)
    found: list[np.ndarray] = []
    with av.open(buffer, "r") as container:
        found.extend(frame.to_ndarray(format="rgb24") for frame in container.decode(video=0))
    return found


def ssim(original: np.ndarray, replay: np.ndarray) -> tuple[float, ...]:
    """SSIM of each pair of (K, H, W, 3) uint8 frames: scikit-image, 7 x 7 windows, the mean over the colour
    channels, of a data range of 255."""
    from skimage.metrics import structural_similarity

    if original.shape != replay.shape:
        raise ScenarioError(
            f"the original's frames are {original.shape[2]} x {original.shape[1]}, the replay's "
            f"{replay.shape[2]} x {replay.shape[1]}; render as the original was rendered, e.g. "
            f"--env observation_height={original.shape[1]} --env observation_width={original.shape[2]}"
        )
    return tuple(
        float(structural_similarity(a, b, channel_axis=-1, data_range=255))
        for a, b in zip(original, replay, strict=True)
    )
