"""Files of the last frames before the handoff: `meta/roborecover/frames/file-000.parquet` and so on.

They lie apart from `scenarios.parquet`: frames are by far the largest part of a scenario, and evaluation,
which does not look at them, never downloads them.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.files import finish_update, read_bytes
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.datasets.parquet_bounds import check_bounds
from lerobot_roborecover.datasets.schema import (
    FOLDER,
    MANIFEST_FILE,
    MAX_FRAMES,
    MAX_MANIFEST_BYTES,
    check_frame,
)
from lerobot_roborecover.scenario import Scenario, ScenarioError

FRAMES_FOLDER = "frames"
MAX_FRAMES_BYTES = 2**28
"""Of one file; a writer begins the next one at half of it."""
MAX_CAMERAS = 64
_NAME = re.compile(FRAMES_FOLDER + r"/file-[0-9]{3,}\.parquet")

SCHEMA = pa.schema(
    [
        pa.field("id", pa.string(), nullable=False),
        pa.field("sha256", pa.string(), nullable=False),
        pa.field("step", pa.int64(), nullable=False),
        pa.field("camera", pa.string(), nullable=False),
        pa.field("frames_png", pa.list_(pa.field("element", pa.binary(), nullable=False)), nullable=False),
    ]
)
"""One row a scenario and camera; the rows of a scenario are one row group."""


def write_frames(folder: Path, frames: Iterable[LastFrames]) -> list[str]:
    """Writes frames as `file-000.parquet` and so on into a folder that does not exist yet.

    Args:
        folder: made with the first frame; none is made where no scenario has a picture.
        frames: drawn one at a time.

    Returns:
        Names of the files, below `folder`.

    Raises:
        ScenarioError: a limit of the format is exceeded.
    """
    names: list[str] = []
    opened: tuple[pq.ParquetWriter, BinaryIO] | None = None

    def close() -> None:
        for part in opened or ():
            part.close()

    try:
        for found in frames:
            _check(found)
            if not found.png:
                continue
            if opened is None:
                folder.mkdir(parents=True, exist_ok=True)
                names.append(f"file-{len(names):03d}.parquet")
                file = open(folder / names[-1], "wb")  # noqa: SIM115
                # PNG is compressed; and without dictionaries, sizes bound what reading takes.
                writer = pq.ParquetWriter(
                    file, SCHEMA, compression="none", use_dictionary=False, write_statistics=False
                )
                opened = writer, file
            writer, file = opened
            rows = [
                (found.scenario_id, found.sha256, found.step, camera, list(png))
                for camera, png in found.png.items()
            ]
            columns = [
                pa.array(values, f.type) for values, f in zip(zip(*rows, strict=True), SCHEMA, strict=True)
            ]
            writer.write_table(pa.Table.from_arrays(columns, schema=SCHEMA))
            if file.tell() > MAX_FRAMES_BYTES // 2:
                close()
                opened = None
    finally:
        close()
    return names


class FrameStore(Mapping[str, LastFrames]):
    """The last frames of a dataset folder by scenario id, read file by file as they are asked for.

    Args:
        root: the dataset's folder. Empty where it has no frames, or only its evaluation part was pulled.

    Raises:
        ScenarioError: a file is missing, or is not what the manifest says.
    """

    def __init__(self, root: Path | str):
        self._root = Path(root)
        finish_update(self._root)
        self._sha256 = self._listed() if (self._root / FOLDER / FRAMES_FOLDER).exists() else {}
        self._open: tuple[str, pq.ParquetFile] | None = None
        self._places: dict[str, tuple[str, int]] = {}
        for name in self._sha256:
            file = self._file(name)
            for group in range(file.metadata.num_row_groups):
                ids = set(file.read_row_group(group, columns=["id"])["id"].to_pylist())
                if len(ids) != 1 or (one := ids.pop()) in self._places:
                    raise ScenarioError(
                        f"{self._path(name)}: row group {group} is not all of one scenario; fetch it again"
                    )
                self._places[one] = (name, group)

    def __getitem__(self, scenario_id: str) -> LastFrames:
        name, group = self._places[scenario_id]
        table = self._file(name).read_row_group(group, columns=SCHEMA.names)
        lists = table["frames_png"].combine_chunks()
        if len(table) > MAX_CAMERAS or len(lists.flatten()) > len(table) * MAX_FRAMES:
            raise ScenarioError(
                f"{self._path(name)}: scenario {scenario_id:.200} has {len(lists.flatten())} frames of "
                f"{len(table)} cameras; the limits are {MAX_CAMERAS} cameras and {MAX_FRAMES} frames of each"
            )
        rows = table.to_pylist()
        png = {row["camera"]: tuple(row["frames_png"]) for row in rows}
        found = LastFrames(scenario_id, rows[0]["sha256"], rows[0]["step"], png)
        try:
            _check(found)
        except ScenarioError as err:
            raise ScenarioError(f"{self._path(name)}: {err}") from None
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def of(self, scenario: Scenario) -> LastFrames:
        """The frames of this very scenario.

        Raises:
            ScenarioError: there are none, or they are of another prefix or reset.
        """
        found = self.get(scenario.id)
        if found is None:
            raise ScenarioError(
                f"{self._root} holds no frames of scenario {scenario.id}; render the dataset, or pull it "
                "whole"
            )
        if found.sha256 != scenario.sha256():
            raise ScenarioError(
                f"{self._root}: the frames of scenario {scenario.id} are of another prefix or reset (sha256 "
                f"{found.sha256:.16}, not {scenario.sha256():.16}); render the dataset again"
            )
        return found

    def _listed(self) -> dict[str, str]:
        """SHA-256 by file, as the manifest has it."""
        path = self._root / FOLDER / MANIFEST_FILE
        try:
            files = json.loads(read_bytes(self._root, path, MAX_MANIFEST_BYTES))["files"]
            found = {str(n): str(e["sha256"]) for n, e in files.items() if _NAME.fullmatch(n)}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
            if isinstance(err, ScenarioError):
                raise
            raise ScenarioError(
                f"{path}, field files: not what write_scenarios writes ({err!r:.80})"
            ) from None
        return dict(sorted(found.items()))

    def _path(self, name: str) -> Path:
        return self._root / FOLDER / name

    def _file(self, name: str) -> pq.ParquetFile:
        """One file, checked; the last one stays open."""
        if self._open is None or self._open[0] != name:
            path = self._path(name)
            data = read_bytes(self._root, path, MAX_FRAMES_BYTES)
            if hashlib.sha256(data).hexdigest() != self._sha256[name]:
                raise ScenarioError(
                    f"{path} does not have the SHA-256 that {MANIFEST_FILE} gives; fetch or render it again"
                )
            try:
                check_bounds(path, data, SCHEMA)
                self._open = (name, pq.ParquetFile(pa.BufferReader(data)))
            except (pa.ArrowException, OSError, ValueError) as err:
                if isinstance(err, ScenarioError):
                    raise
                raise ScenarioError(f"{path} cannot be decoded as parquet: {str(err)[:200]}") from None
        return self._open[1]


def _check(found: LastFrames) -> None:
    for camera, frames in found.png.items():
        where = f"scenario {found.scenario_id:.200}, camera {camera:.80}"
        if not 1 <= len(frames) <= MAX_FRAMES:
            raise ScenarioError(f"{where}: {len(frames)} frames; there may be 1 to {MAX_FRAMES}")
        for i, frame in enumerate(frames):
            check_frame(f"{where}: frame {i}", frame)
