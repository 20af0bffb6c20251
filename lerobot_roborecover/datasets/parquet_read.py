"""Reads parquet files that may come from outside: bounded in memory, and refused in one line.

Every reader of a dataset's `data/` and `meta/episodes/` goes through here; scenario files have stricter
bounds of their own (`parquet_bounds.check_bounds`). The lists and texts of scenario rows are counted on Arrow
(`check_lengths`), before Python objects are made of them: an empty list or an empty JSON object costs next to
nothing in a file, and a hundred bytes and more in Python.
"""

from __future__ import annotations

import mmap
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.parquet_bounds import check_decoded_size, check_fixed_lists
from lerobot_roborecover.datasets.schema import (
    MAX_BODIES,
    MAX_FRAMES,
    MAX_PROVENANCE_BYTES,
    MAX_VERSIONS,
    RESET_OPTIONS,
)
from lerobot_roborecover.rollout import MAX_OPTIONS_CHARS
from lerobot_roborecover.scenario import ScenarioError

MAX_JSON_CONTAINERS = 2**20
"""JSON lists and objects in a file's texts, and `JSON_CONTAINERS_PER_ROW` more for every row."""
JSON_CONTAINERS_PER_ROW = 100
_UTF8_BYTES = 4


@contextmanager
def open_parquet(path: Path) -> Generator[pq.ParquetFile]:
    """Opens a file whose decoded size is bounded by its own.

    Args:
        path: a regular file, or a link to one.

    Raises:
        ScenarioError: it is missing, damaged, no parquet, or would fill the memory; also raised where reading
            it inside the context fails.
    """
    try:
        if not path.is_file():
            raise ScenarioError(f"{path} is not a regular file; fetch or write the dataset again")
        with open(path, "rb") as file:
            if not path.stat().st_size:
                raise ScenarioError(f"{path} is empty; fetch or write the dataset again")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                values = check_decoded_size(path, data)
        with pq.ParquetFile(path) as opened:
            check_fixed_lists(path, opened, values)
            yield opened
    except (OSError, ValueError, IndexError, OverflowError, pa.ArrowException) as err:
        if isinstance(err, ScenarioError):
            raise
        raise ScenarioError(f"{path} cannot be read as parquet ({err!s:.200}); fetch it again") from None


def column_names(path: Path) -> list[str]:
    """Returns the names of a file's columns.

    Raises:
        ScenarioError: see `open_parquet`.
    """
    with open_parquet(path) as file:
        return list(file.schema_arrow.names)


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Reads a file, or some of its columns.

    Args:
        path: the file.
        columns: all of them by default.

    Raises:
        ScenarioError: a column is missing; see also `open_parquet`.
    """
    with open_parquet(path) as file:
        missing = [name for name in columns or () if name not in file.schema_arrow.names]
        if missing:
            raise ScenarioError(f"{path} has no column {missing[0]}; fetch or write the dataset again")
        table = file.read(columns=None if columns is None else list(columns))
        table.validate(full=True)
        return table


def read_numbers(path: Path, columns: Sequence[str]) -> dict[str, np.ndarray]:
    """Reads columns of numbers, or of lists of as many numbers each.

    Args:
        path: the file.
        columns: their names.

    Returns:
        An array per column, (rows,) or (rows, numbers).

    Raises:
        ScenarioError: a column is missing, or holds something else; see also `open_parquet`.
    """
    table = read_table(path, columns)
    try:
        return {name: number_array(table[name]) for name in columns}
    except ValueError as err:
        raise ScenarioError(f"{path}: {err}; fetch or write the dataset again") from None


def episodes_of(root: Path, columns: Sequence[str]) -> Iterator[tuple[Path, dict[str, np.ndarray]]]:
    """Yields LeRobot's metadata of the episodes, file by file, as plain numbers.

    Args:
        root: the dataset's folder.
        columns: numbers that are needed.

    Raises:
        ScenarioError: a file is not LeRobot's.
    """
    for path in sorted((root / "meta" / "episodes").rglob("*.parquet")):
        numbers = read_numbers(path, columns)
        wrong = [name for name, array in numbers.items() if array.ndim != 1]
        if wrong:
            raise ScenarioError(f"{path}: column {wrong[0]} holds lists, not numbers; fetch it again")
        yield path, numbers


def read_frames(root: Path, columns: Sequence[str]) -> dict[int, dict[str, np.ndarray]]:
    """Reads columns of numbers of every episode, its frames in order.

    Args:
        root: the dataset's folder.
        columns: their names.

    Returns:
        By episode and column, (frames, numbers).

    Raises:
        ScenarioError: a file lacks a column, or is not readable.
    """
    found: dict[int, list[tuple[np.ndarray, ...]]] = {}
    for path in sorted((root / "data").rglob("*.parquet")):
        table = read_numbers(path, ["episode_index", "frame_index", *columns])
        episodes, frames = table["episode_index"], table["frame_index"]
        if episodes.ndim != 1 or frames.ndim != 1:
            raise ScenarioError(f"{path}: its episode or frame numbers are lists; fetch the dataset again")
        # LeRobot stores features of one value as plain numbers, not as lists.
        values = [array.reshape(len(array), -1) for array in (table[name] for name in columns)]
        order = np.lexsort((frames, episodes))
        numbers, starts = np.unique(episodes[order], return_index=True)
        for number, rows in zip(numbers.tolist(), np.split(order, starts[1:]), strict=True):
            found.setdefault(number, []).append((frames[rows], *(array[rows] for array in values)))
    episodes_found = {}
    for number, parts in found.items():
        widths = {tuple(array.shape[1:] for array in part) for part in parts}
        if len(widths) > 1:
            raise ScenarioError(f"{root}/data: frames of episode {number} differ in width; fetch it again")
        frames, *joined = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        order = np.argsort(frames, kind="stable")
        episodes_found[number] = {n: a[order] for n, a in zip(columns, joined, strict=True)}
    return episodes_found


def number_array(column: pa.ChunkedArray) -> np.ndarray:
    """Returns a column of numbers, (rows,), or of lists of as many numbers each, (rows, numbers).

    Raises:
        ValueError: it holds something else.
    """
    parts = [number_view(chunk) for chunk in column.chunks]
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError("a column whose lists differ in length")
    return np.concatenate(parts) if parts else np.empty(0)


def number_view(array: pa.Array) -> np.ndarray:
    """Returns an Arrow array as numbers, without copying them (`to_numpy` imports pandas, which is slow).

    Raises:
        ValueError: it holds something else, or lists that differ in length.
    """
    kind, rows = array.type, len(array)
    if array.null_count:
        raise ValueError("a column of numbers with nulls in it")
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        if not pa.types.is_fixed_size_list(kind):
            lengths = np.diff(number_view(array.offsets))
            if rows and (lengths != lengths[0]).any():
                raise ValueError("a column whose lists differ in length")
        values = number_view(array.flatten())
        if values.ndim != 1:
            raise ValueError("a column of lists of lists, not of numbers")
        return values.reshape(rows, -1) if rows else values.reshape(0, 0)
    if pa.types.is_boolean(kind):
        packed = np.frombuffer(array.buffers()[1], np.uint8) if rows else np.empty(0, np.uint8)
        bits = np.unpackbits(packed, bitorder="little")
        return bits[array.offset : array.offset + rows].astype(bool)
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        raise ValueError(f"a column of {kind!s:.60}, not of numbers")
    dtype = np.dtype(kind.to_pandas_dtype())
    if not rows:
        return np.empty(0, dtype)
    return np.frombuffer(array.buffers()[1], dtype, rows, array.offset * dtype.itemsize)


def check_lengths(batch: pa.RecordBatch) -> None:
    """Checks the lists and texts of scenario rows whose number has a limit.

    Raises:
        ScenarioError: names the row within the batch, the field, the number and the limit.
    """
    mark = batch.column("fingerprint")
    bounded = {
        "provenance bytes of JSON": (batch.column("provenance"), MAX_PROVENANCE_BYTES),
        "reset fixtures": (batch.column("fixtures"), MAX_BODIES),
        "fingerprint bodies": (mark.field("bodies"), MAX_BODIES),
        "fingerprint versions": (mark.field("versions"), MAX_VERSIONS),
        "fingerprint frames_png": (mark.field("frames_png"), MAX_FRAMES),
    }
    if RESET_OPTIONS.name in batch.schema.names:
        options = batch.column(RESET_OPTIONS.name)
        bounded[f"{RESET_OPTIONS.name} bytes of JSON"] = (options, MAX_OPTIONS_CHARS * _UTF8_BYTES)
    for label, (array, limit) in bounded.items():
        lengths = np.diff(_offsets(array))
        longest = int(lengths.argmax())
        if lengths[longest] > limit:
            raise RowTooLongError(longest, f"{label}: {lengths[longest]}; the limit is {limit}")


class RowTooLongError(ScenarioError):
    """A list or text of one row is longer than its limit."""

    def __init__(self, row: int, message: str):
        super().__init__(message)
        self.row = row


def json_containers(batch: pa.RecordBatch) -> int:
    """Returns a bound of the number of lists and objects in the JSON texts of scenario rows."""
    found = 0
    for name in ("provenance", RESET_OPTIONS.name):
        if name in batch.schema.names and (data := batch.column(name).buffers()[2]) is not None:
            offsets = _offsets(batch.column(name))
            text = bytes(memoryview(data)[offsets[0] : offsets[-1]])
            found += text.count(b"{") + text.count(b"[")
    return found


def _offsets(array: pa.Array) -> np.ndarray:
    if isinstance(array, pa.ListArray):
        return number_view(array.offsets)
    return np.frombuffer(array.buffers()[1], np.int32, len(array) + 1, array.offset * 4)
