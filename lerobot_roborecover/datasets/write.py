"""Writes a scenario dataset's `meta/roborecover/` folder."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover._version import __version__
from lerobot_roborecover.datasets.episodes import render_prefix
from lerobot_roborecover.datasets.files import FolderUpdate, update_folder
from lerobot_roborecover.datasets.frame_files import FRAMES_FOLDER, write_frames
from lerobot_roborecover.datasets.frames import LastFrames
from lerobot_roborecover.datasets.schema import (
    FOLDER,
    MANIFEST_FILE,
    MAX_PARQUET_BYTES,
    RESET_OPTIONS,
    SCENARIOS_FILE,
    SCHEMA,
    SCHEMA_VERSION,
    check_set,
    counts,
    package_versions,
    to_row,
)
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_file, atomic_write, remove_stale

_ROWS_PER_GROUP = 64
"""Rows converted at a time: bounds memory where scenarios carry frames."""


def write_scenarios(
    root: str | os.PathLike[str],
    scenarios: Iterable[Scenario],
    *,
    description: str = "",
    license: str | None = None,
    episodes: Iterable[Iterable[Mapping[str, np.ndarray]]] | None = None,
    fps: int | None = None,
    frames: Iterable[LastFrames] = (),
) -> Path:
    """Writes `meta/roborecover/scenarios.parquet` and `manifest.json` below a dataset's root.

    A reader sees the old set or the new set, never a mixture (`files.update_folder`).

    Args:
        root: the dataset's folder; made if missing, and replaced set by set if there already is one.
        scenarios: of one platform, with unique ids.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.
        episodes: for each scenario the frames of its prefix (`episodes.render_prefix`). With them the root
            becomes a complete LeRobotDataset, put in place as a whole; it must be new or empty.
        fps: frame rate of the episodes; needed with them.
        frames: the last frames before the handoff, of any of the scenarios; drawn after the episodes. Those
            of an earlier set go in any case.

    Returns:
        `root`, as `read_scenarios` and `load_scenarios` take it.

    Raises:
        ScenarioError: no scenarios, a duplicate id, more than one platform, or a limit of the format
            exceeded.
    """
    scenarios = list(scenarios)
    check_set(scenarios)
    root = Path(root)
    if episodes is None and not (root / FOLDER).exists():
        _write_folder(root / FOLDER, scenarios, description, license, frames)
    elif episodes is None:
        with update_folder(root) as update:
            replace_scenarios(update, scenarios, description=description, license=license, frames=frames)
    else:
        _write_dataset(root, scenarios, description, license, episodes, fps, frames)
    return root


def write_episodes(
    root: str | os.PathLike[str],
    scenarios: Sequence[Scenario],
    simulator_factory: Callable[[], Simulator],
    *,
    fps: int | None = None,
    description: str = "",
    license: str | None = None,
) -> Path:
    """Renders every scenario's prefix and writes the complete dataset: episodes and `meta/roborecover/`.

    Args:
        root: the dataset's folder; must be new or empty.
        scenarios: of one platform, each with a prefix of at least one action.
        simulator_factory: makes the simulator that renders; its observation options decide the features.
        fps: frame rate of the episodes; the simulator's control rate by default.
        description: free text for the manifest.
        license: SPDX identifier, or None where none is decided.

    Raises:
        ScenarioError: the folder is not empty, a prefix is, or the set is invalid.
        SimulatorError: a scenario cannot be replayed.
    """
    simulator = simulator_factory()
    last: list[LastFrames] = []
    try:
        return write_scenarios(
            root,
            scenarios,
            description=description,
            license=license,
            episodes=(render_prefix(simulator, scenario, last) for scenario in scenarios),
            frames=last,
            fps=fps or round(simulator.control_hz),
        )
    finally:
        simulator.close()


def replace_scenarios(
    update: FolderUpdate,
    scenarios: Iterable[Scenario],
    *,
    description: str = "",
    license: str | None = None,
    frames: Iterable[LastFrames] = (),
) -> None:
    """Writes scenarios in the place of a dataset's, as a part of an update; see `write_scenarios`."""
    scenarios = list(scenarios)
    check_set(scenarios)
    _write_folder(update.folder / FOLDER, scenarios, description, license, frames)
    update.replace_folder(f"{FOLDER}/{FRAMES_FOLDER}")


def _write_folder(
    folder: Path,
    scenarios: Sequence[Scenario],
    description: str,
    license: str | None,
    frames: Iterable[LastFrames],
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{FRAMES_FOLDER}.{os.getpid()}.tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    remove_stale(folder / FRAMES_FOLDER)
    try:
        names = write_frames(temporary, frames)
        with atomic_file(folder / SCENARIOS_FILE) as path, open(path, "wb") as file:
            _write_parquet(file, scenarios)
        shutil.rmtree(folder / FRAMES_FOLDER, ignore_errors=True)
        if names:
            os.replace(temporary, folder / FRAMES_FOLDER)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    files = [SCENARIOS_FILE, *(f"{FRAMES_FOLDER}/{name}" for name in names)]
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "platform": scenarios[0].platform,
        "description": description,
        "license": license,
        "versions": package_versions(scenarios),
        "written_by": {"lerobot_env_roborecover": __version__},
        "counts": counts(scenarios),
        "files": {
            name: {"bytes": (folder / name).stat().st_size, "sha256": file_sha256(folder / name)}
            for name in files
        },
    }
    text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
    atomic_write(folder / MANIFEST_FILE, text)


def _write_dataset(
    root: Path,
    scenarios: Sequence[Scenario],
    description: str,
    license: str | None,
    episodes: Iterable[Iterable[Mapping[str, np.ndarray]]],
    fps: int | None,
    frames: Iterable[LastFrames],
) -> None:
    # LeRobot comes in with it.
    from lerobot_roborecover.datasets.encoding import write_lerobot_dataset

    if fps is None:
        raise ScenarioError("episodes need a frame rate; pass fps, e.g. the simulator's control_hz")
    with atomic_dir(root) as folder:
        write_lerobot_dataset(folder, scenarios, episodes, fps)
        _write_folder(folder / FOLDER, scenarios, description, license, frames)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_parquet(file: IO[bytes], scenarios: Sequence[Scenario]) -> None:
    # No dictionaries: with plain values the sizes in a file's metadata bound what reading it takes, and the
    # reader insists on that. zstd compresses repeats as well.
    # Actions are most of a file: sorted by byte they take a fifth less, and poses too.
    pose = "fingerprint.bodies.list.element"
    by_byte = [f"{name}.list.element" for name in ("prefix", f"{pose}.position_m", f"{pose}.quat_xyzw")]
    options = {
        "compression": "zstd",
        "compression_level": 19,
        "use_dictionary": False,
        "write_statistics": False,
        "column_encoding": dict.fromkeys(by_byte, "BYTE_STREAM_SPLIT"),
    }
    schema = pa.schema([*SCHEMA, RESET_OPTIONS]) if any(s.reset.options for s in scenarios) else SCHEMA
    with pq.ParquetWriter(file, schema, **options) as writer:
        for begin in range(0, len(scenarios), _ROWS_PER_GROUP):
            rows = [to_row(s) for s in scenarios[begin : begin + _ROWS_PER_GROUP]]
            try:
                columns = [pa.array([row[f.name] for row in rows], f.type) for f in schema]
            except UnicodeEncodeError as err:
                raise ScenarioError(
                    f"rows {begin} to {begin + len(rows) - 1}: text is not valid Unicode: {err}"
                ) from None
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))
    if file.tell() > MAX_PARQUET_BYTES:
        raise ScenarioError(
            f"{SCENARIOS_FILE} would have {file.tell()} bytes; the limit is {MAX_PARQUET_BYTES}. "
            "Leave out fingerprint frames, or split the set"
        )
