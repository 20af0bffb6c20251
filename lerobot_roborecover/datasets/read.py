"""Reads a scenario dataset's `meta/roborecover/` folder, trusting nothing in it.

In this order, so that nothing large or strange is touched before it is known to be neither:

1. both files are regular files, inside the dataset, and not too large;
2. the manifest is JSON of a schema version that this code knows;
3. the parquet has the hash that the manifest gives, the columns of the schema, and sizes within bounds;
4. every row makes a valid scenario with the hash it claims;
5. the counts agree with the manifest.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.files import read_bytes, what_it_is
from lerobot_roborecover.datasets.parquet_bounds import check_bounds
from lerobot_roborecover.datasets.parquet_read import (
    JSON_CONTAINERS_PER_ROW,
    MAX_JSON_CONTAINERS,
    RowTooLongError,
    check_lengths,
    json_containers,
    number_view,
)
from lerobot_roborecover.datasets.schema import (
    FOLDER,
    MANIFEST_FILE,
    MAX_MANIFEST_BYTES,
    MAX_PARQUET_BYTES,
    RESET_OPTIONS,
    SCENARIOS_FILE,
    SCHEMA,
    SCHEMA_VERSION,
    check_limits,
    check_set,
    counts,
)
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Fingerprint, Pose, Reset, Scenario, ScenarioError, Task

_FETCH_AGAIN = "Fetch or write the dataset again"


def read_scenarios(root: str | os.PathLike[str]) -> list[Scenario]:
    """Reads every scenario of a dataset folder, in the order it was written.

    Args:
        root: the dataset's folder, the one that holds `meta/roborecover/`.

    Raises:
        ScenarioError: names the file and, where it applies, the row, the field, the value, the limit and the
            remedy.
    """
    return read_with_manifest(root)[0]


def read_with_manifest(root: str | os.PathLike[str]) -> tuple[list[Scenario], dict[str, Any]]:
    """Reads every scenario and the manifest of a dataset folder; see `read_scenarios`."""
    while True:
        before = _stamp(root)
        try:
            return _read(root)
        except ScenarioError:
            if _stamp(root) == before:
                raise  # else its files were replaced between two reads


def _stamp(root: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Returns what tells a manifest from one that takes its place."""
    try:
        found = os.stat(Path(root) / FOLDER / MANIFEST_FILE)
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _read(root: str | os.PathLike[str]) -> tuple[list[Scenario], dict[str, Any]]:
    folder = Path(root) / FOLDER
    manifest = _read_manifest(Path(root))
    path = folder / SCENARIOS_FILE
    data = read_bytes(Path(root), path, MAX_PARQUET_BYTES)
    expected = manifest["files"][SCENARIOS_FILE]["sha256"]
    if data[:4] != b"PAR1" or data[-4:] != b"PAR1":
        raise ScenarioError(f"{path} is not a complete parquet file: {what_it_is(data)}. {_FETCH_AGAIN}")
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise ScenarioError(
            f"{path} has SHA-256 {found}, {MANIFEST_FILE} says {expected}: the two are not of one writing. "
            f"{_FETCH_AGAIN}"
        )
    scenarios = _parse(path, data)
    with _at(str(path)):
        check_set(scenarios)
    _check_counts(folder / MANIFEST_FILE, manifest, scenarios)
    return scenarios, manifest


def _read_manifest(root: Path) -> dict[str, Any]:
    path = root / FOLDER / MANIFEST_FILE
    data = read_bytes(root, path, MAX_MANIFEST_BYTES)
    try:
        manifest = json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as err:
        raise ScenarioError(f"{path} is not JSON ({err}): {what_it_is(data)}. {_FETCH_AGAIN}") from None
    if not isinstance(manifest, dict):
        raise ScenarioError(f"{path} holds a JSON {type(manifest).__name__}, not an object. {_FETCH_AGAIN}")
    version = manifest.get("schema_version")
    if type(version) is not int or version < 1:
        raise ScenarioError(
            f"{path}, field schema_version: {version!r:.80} is not a version number. {_FETCH_AGAIN}"
        )
    if version > SCHEMA_VERSION:
        raise ScenarioError(
            f"{path}, field schema_version: {version} is from the future; this package reads up to "
            f"{SCHEMA_VERSION}. Upgrade it: pip install -U lerobot_env_roborecover"
        )
    files = manifest.get("files")
    entry = files.get(SCENARIOS_FILE) if isinstance(files, dict) else None
    if not isinstance(entry, dict) or not isinstance(entry.get("sha256"), str):
        raise ScenarioError(f"{path}, field files: gives no sha256 of {SCENARIOS_FILE}. {_FETCH_AGAIN}")
    return manifest


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a finite number")


def _parse(path: Path, data: bytes) -> list[Scenario]:
    scenarios: list[Scenario] = []
    containers = 0
    for batch in _batches(path, data):
        row = len(scenarios)
        try:
            check_lengths(batch)
        except RowTooLongError as err:
            long = batch.column("id")[err.row].as_py()
            raise ScenarioError(f"{path}: row {row + err.row} (scenario {long!r:.140}): {err}") from None
        containers += json_containers(batch)
        limit = MAX_JSON_CONTAINERS + JSON_CONTAINERS_PER_ROW * (row + len(batch))
        if containers > limit:
            raise ScenarioError(
                f"{path}: up to row {row + len(batch) - 1}, field provenance holds {containers} JSON lists "
                f"and objects; the limit is {limit}. Keep less in provenance, or split the dataset"
            )
        scenarios.extend(_scenarios(path, batch, row))
    return scenarios


def _batches(path: Path, data: bytes) -> Iterator[pa.RecordBatch]:
    """Yields the rows, some dozens at a time; no more than a row group is decoded at once."""
    try:
        schema = check_bounds(path, data, SCHEMA, optional=[RESET_OPTIONS])
        with pq.ParquetFile(pa.BufferReader(data)) as file:
            for group in range(file.num_row_groups):
                table = file.read_row_group(group, columns=schema.names, use_threads=False)
                table.validate(full=True)
                yield from table.to_batches(max_chunksize=64)
    except ScenarioError:
        raise
    except (pa.ArrowException, OSError, ValueError, OverflowError) as err:
        raise ScenarioError(f"{path} cannot be decoded as parquet: {str(err)[:300]}. {_FETCH_AGAIN}") from err


def _scenarios(path: Path, batch: pa.RecordBatch, row: int) -> Iterator[Scenario]:
    """Yields the scenarios of rows whose first is row `row` of its file."""
    prefixes = batch.column("prefix")
    offsets, values = number_view(prefixes.offsets), number_view(prefixes.values)
    for i, record in enumerate(batch.drop_columns(["prefix"]).to_pylist()):
        with _at(f"{path}: row {row + i} (scenario {record['id']!r:.140})"):
            yield _to_scenario(record, values[offsets[i] : offsets[i + 1]].copy())


def _to_scenario(record: Mapping[str, Any], prefix: np.ndarray) -> Scenario:
    """A row as a scenario; `prefix` is flat float64."""
    steps, width = record["prefix_steps"], record["action_dim"]
    if not 1 <= width <= 64 or steps < 0 or steps * width != len(prefix):
        raise ScenarioError(
            f"field prefix: {len(prefix)} numbers are not prefix_steps = {steps} actions of action_dim = "
            f"{width}"
        )
    platform_named(record["platform"]).check_width(width, f"scenario {record['id']!s:.140}")
    with _at("field provenance"):
        provenance = _object(record["provenance"])
    mark = record["fingerprint"]
    with _at(f"field {RESET_OPTIONS.name}"):
        options = _object(record.get(RESET_OPTIONS.name) or "{}")
    with _at("field fixtures"):
        fixtures = _poses(record["fixtures"])
    with _at("field fingerprint"):
        fingerprint = mark and Fingerprint(
            step=mark["step"],
            bodies=_poses(mark["bodies"]),
            state_sha256=mark["state_sha256"],
            versions=_unique((v["key"], v["value"]) for v in mark["versions"]),
            frames_png=tuple(mark["frames_png"]),
        )
    scenario = Scenario(
        id=record["id"],
        task=Task(*(record[k] for k in ("platform", "suite", "name", "instruction", "horizon"))),
        reset=Reset(
            seed=record["seed"],
            init_state_index=record["init_state_index"],
            settle_steps=record["settle_steps"],
            fixtures=fixtures,
            options=options,
        ),
        prefix=prefix.reshape(steps, width),
        stage=record["stage"],
        deviation=record["deviation_type"],
        source=record["source"],
        source_policy=record["source_policy"],
        split=record["split"],
        cluster=record["cluster"],
        provenance=provenance,
        fingerprint=fingerprint,
    )
    check_limits(scenario)
    if scenario.sha256() != record["sha256"]:
        raise ScenarioError(
            f"field sha256: {record['sha256']!r:.80}, but task, reset and prefix give {scenario.sha256()}. "
            f"{_FETCH_AGAIN}"
        )
    return scenario


def _object(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as err:
        raise ScenarioError(f"not JSON: {err}") from None
    if not isinstance(found, dict):
        raise ScenarioError(f"a JSON {type(found).__name__}, not an object")
    return found


def _poses(rows: list[Mapping[str, Any]]) -> dict[str, Pose]:
    return _unique((r["name"], Pose(tuple(r["position_m"]), tuple(r["quat_xyzw"]))) for r in rows)


def _unique[T](items: Iterator[tuple[str, T]]) -> dict[str, T]:
    found: dict[str, T] = {}
    for key, value in items:
        if key in found:
            raise ScenarioError(f"{key!r:.80} occurs twice; names are unique within a scenario")
        found[key] = value
    return found


def _check_counts(path: Path, manifest: Mapping[str, Any], scenarios: list[Scenario]) -> None:
    claimed = manifest.get("counts")
    for key, found in counts(scenarios).items():
        value = claimed.get(key) if isinstance(claimed, dict) else None
        if value != found:
            raise ScenarioError(
                f"{path}, field counts.{key}: {str(value)[:200]}, but {SCENARIOS_FILE} holds "
                f"{str(found)[:200]}. "
                f"{_FETCH_AGAIN}"
            )
    if manifest.get("platform") != scenarios[0].platform:
        raise ScenarioError(
            f"{path}, field platform: {manifest.get('platform')!r:.80}, but {SCENARIOS_FILE} holds "
            f"scenarios of {scenarios[0].platform!r}. {_FETCH_AGAIN}"
        )


@contextmanager
def _at(where: str) -> Generator[None]:
    """Puts where it happened before the message of a refusal."""
    try:
        yield
    except ScenarioError as err:
        raise ScenarioError(f"{where}: {err}") from None
