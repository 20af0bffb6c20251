"""Recovery frames that a dataset holds, and a grid of them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import decode_png
from lerobot_roborecover.scenario import Scenario

TILE = 256
"""Width and height of a tile's picture, pixels."""
_CAPTION = 34
_COLUMNS = 4


def spread(scenarios: Sequence[Scenario], count: int) -> list[int]:
    """Rows of up to `count` scenarios, taken from every cell in turn."""
    by_cell: dict[str, list[int]] = {}
    for row, scenario in enumerate(scenarios):
        by_cell.setdefault(scenario.cell, []).append(row)
    queues = [by_cell[cell] for cell in sorted(by_cell)]
    picked: list[int] = []
    while len(picked) < count and any(queues):
        for queue in queues:
            if queue and len(picked) < count:
                picked.append(queue.pop(0))
    return picked


def stored_frame(root: Path, scenarios: Sequence[Scenario], row: int, store: FrameStore) -> np.ndarray | None:
    """A scenario's recovery frame as the dataset holds it: lossless, or the last of its episode's video.

    Args:
        root: the dataset's folder.
        scenarios: all of its scenarios.
        row: which one.
        store: the dataset's last frames.

    Returns:
        (H, W, 3) uint8, or None where the dataset holds no pictures.
    """
    mark = scenarios[row].fingerprint
    if mark is not None and mark.frames_png:
        return decode_png(mark.frames_png[-1])
    if scenarios[row].id in store:
        return next(iter(store.of(scenarios[row]).arrays().values()))[-1]
    return _episode_frame(root, row)


def grid_png(tiles: Sequence[tuple[str, str, np.ndarray]]) -> bytes:
    """A grid of captioned pictures as PNG.

    Args:
        tiles: two lines of caption and an (H, W, 3) uint8 picture each.
    """
    from PIL import Image, ImageDraw

    columns = min(_COLUMNS, len(tiles))
    rows = -(-len(tiles) // columns)
    grid = Image.new("RGB", (columns * (TILE + 8) + 8, rows * (TILE + _CAPTION + 8) + 8), "white")
    draw = ImageDraw.Draw(grid)
    for i, (first, second, picture) in enumerate(tiles):
        x, y = 8 + i % columns * (TILE + 8), 8 + i // columns * (TILE + _CAPTION + 8)
        grid.paste(Image.fromarray(picture).resize((TILE, TILE), Image.Resampling.LANCZOS), (x, y))
        draw.text((x, y + TILE + 2), first[:42], fill="black")
        draw.text((x, y + TILE + 16), second[:42], fill="#555555")
    buffer = io.BytesIO()
    grid.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def _episode_frame(root: Path, row: int) -> np.ndarray | None:
    """The last frame of an episode, from its first camera's video."""
    from lerobot_roborecover.datasets.files import load_json, read_bytes
    from lerobot_roborecover.datasets.parquet_read import episodes_of
    from lerobot_roborecover.datasets.video_frames import MAX_INFO_BYTES

    info = root / "meta" / "info.json"
    if not info.is_file():
        return None
    features = load_json(read_bytes(root, info, MAX_INFO_BYTES)).get("features", {})
    cameras = [key for key, feature in features.items() if feature.get("dtype") == "video"]
    if not cameras:
        return None
    key = cameras[0]
    names = [f"videos/{key}/{part}" for part in ("chunk_index", "file_index", "to_timestamp")]
    for _, table in episodes_of(root, ["episode_index", *names]):
        for at in (table["episode_index"] == row).nonzero()[0]:
            chunk, file, end = (table[name][at].item() for name in names)
            return _frame_before(root / "videos" / key / f"chunk-{chunk:03d}" / f"file-{file:03d}.mp4", end)
    return None


def _frame_before(path: Path, end_s: float) -> np.ndarray | None:
    """The last frame of a video that starts before a time."""
    import av

    if not path.is_file():
        return None
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if stream.time_base is None:
            return None
        container.seek(max(int((end_s - 0.5) / stream.time_base), 0), stream=stream)
        found = None
        for frame in container.decode(stream):
            if frame.time is None or frame.time > end_s - 1e-3:
                break
            found = frame
        return None if found is None else found.to_ndarray(format="rgb24")
