"""Bounds what decoding an untrusted parquet takes, before any of it is decoded.

A few bytes of parquet can stand for gigabytes: compressed pages, dictionary entries repeated by run lengths,
empty lists, nulls. The sizes in a footer can lie, so the page headers are what is added up here. What a file
decodes to may be `SLACK_BYTES` and so many times the file's own size. Scenario files are held to more: they
hold never-null values as they are, at most sorted by byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.parquet_pages import (
    BYTE_ARRAY,
    BYTE_STREAM_SPLIT,
    CODECS,
    DICTIONARY,
    ENCODINGS,
    PLAIN,
    Chunk,
    Page,
    PagesError,
    read_chunks,
)
from lerobot_roborecover.datasets.schema import MAX_SCENARIOS, MAX_UNCOMPRESSED_BYTES, SCHEMA
from lerobot_roborecover.scenario import ScenarioError

MAX_PAGES = 2**20
MAX_VALUES = MAX_UNCOMPRESSED_BYTES // 8
SLACK_BYTES = 2**26
MAX_EXPANSION = 200
"""Honest recordings decode to some 3 to 30 times their file's size."""
MAX_SCENARIO_EXPANSION = 50
"""Scenario files hold no dictionaries; honest ones decode to 2 to 4 times their size."""
_VALUE_BYTES = 16
"""What Arrow keeps of any value, at most: the number, its levels while it is read, offsets of its lists."""


def check_bounds(
    path: Path, data: bytes, schema: pa.Schema = SCHEMA, optional: Sequence[pa.Field] = ()
) -> pa.Schema:
    """Checks columns, row count, encodings and decoded sizes of a scenario file.

    Args:
        path: for messages only.
        data: the whole file.
        schema: columns that it must have.
        optional: columns that it may have.

    Returns:
        The columns to read.

    Raises:
        ScenarioError: a column is missing or of another type, or a bound is exceeded.
        pyarrow.ArrowException, OSError, ValueError: the file is not decodable at all.
    """
    chunks = _chunks(path, data)
    file = pq.ParquetFile(pa.BufferReader(data))
    schema = pa.schema([*schema, *(f for f in optional if f.name in file.schema_arrow.names)])
    for field in schema:
        at = file.schema_arrow.get_field_index(field.name)
        if at < 0:
            raise ScenarioError(f"{path}: field {field.name} is missing; write the file with write_scenarios")
        found = file.schema_arrow.field(at)
        if found.type != field.type or found.nullable != field.nullable:
            raise ScenarioError(
                f"{path}: field {field.name} is {found!s:.200}; it must be {field!s:.200}. "
                "Write the file with write_scenarios"
            )
    rows = file.metadata.num_rows
    if rows > MAX_SCENARIOS:
        raise ScenarioError(f"{path} has {rows} rows; the limit is {MAX_SCENARIOS}. Split the dataset")
    # Every column, also those that the schema does not name: what a column is called here and which one the
    # Arrow reader takes it for need not agree.
    _add_up(path, data, chunks, MAX_SCENARIO_EXPANSION, plain=True)
    return schema


def check_decoded_size(path: Path, data: Any) -> int:
    """Checks how large any parquet file is once it is decoded, all of its columns together.

    Args:
        path: for messages only.
        data: the whole file, as bytes or a memory map.

    Returns:
        The number of values in the file.

    Raises:
        ScenarioError: the file is malformed, or decodes to more than `MAX_EXPANSION` times its size.
    """
    chunks = _chunks(path, data)
    _add_up(path, data, chunks, MAX_EXPANSION, plain=False)
    return sum(chunk.values for chunk in chunks)


def check_fixed_lists(path: Path, file: pq.ParquetFile, values: int) -> None:
    """Checks lists of a fixed size, which take that size also where they are null and hold no value.

    Args:
        path: for the size and messages.
        file: opened.
        values: of `check_decoded_size`.

    Raises:
        ScenarioError: they decode to more than `MAX_EXPANSION` times the file's size.
    """
    rows, limit = file.metadata.num_rows, SLACK_BYTES + MAX_EXPANSION * path.stat().st_size
    decoded = sum(_fixed_bytes(field.type, rows, values) for field in file.schema_arrow)
    if decoded > limit:
        raise ScenarioError(_too_much(f"{path}: lists of a fixed size", decoded, "bytes decoded", limit))


def _chunks(path: Path, data: Any) -> list[Chunk]:
    try:
        return read_chunks(data)
    except PagesError as err:
        raise ScenarioError(f"{path}: {err}") from None


def _add_up(path: Path, data: Any, chunks: list[Chunk], expansion: int, *, plain: bool) -> None:
    """Adds up the pages of all column chunks and checks every sum on the way."""
    most = SLACK_BYTES + expansion * len(data)
    limits = {
        "pages": MAX_PAGES,
        "values": MAX_VALUES if plain else most // _VALUE_BYTES,
        "bytes uncompressed": min(MAX_UNCOMPRESSED_BYTES, most) if plain else most,
        "bytes decoded": most,
    }
    sums = dict.fromkeys(limits, 0)
    copied: list[tuple[str, Chunk, Page, int]] = []
    for chunk in chunks:
        where = f"{path}: field {chunk.name}"
        values, coded = 0, 0
        dictionary: Page | None = None
        try:
            for page in chunk.pages(data):
                if (page.encoding not in ENCODINGS and page.encoding >= 0) or (plain and not _is_plain(page)):
                    raise ScenarioError(_NOT_PLAIN.format(where) if plain else _UNBOUNDED.format(where))
                values += 0 if page.dictionary else page.values
                sums["pages"] += 1
                sums["values"] += page.values
                sums["bytes uncompressed"] += page.uncompressed
                sums["bytes decoded"] += page.uncompressed + page.values * (_VALUE_BYTES + chunk.width)
                _check(where, sums, limits)
                if page.dictionary:
                    dictionary = page
                elif page.encoding in DICTIONARY and chunk.kind == BYTE_ARRAY:
                    coded += page.values
        except PagesError as err:
            raise ScenarioError(f"{path}: {err}") from None
        if values != chunk.values:
            raise ScenarioError(
                f"{where}: its pages hold {values} values, the footer says {chunk.values}; fetch it again"
            )
        if coded:
            if dictionary is None:
                raise ScenarioError(f"{where} has no dictionary; fetch the file again")
            copied.append((where, chunk, dictionary, coded))
    # Texts are copied from their dictionary. How long its entries are is only looked at where that matters.
    if sums["bytes decoded"] + sum(coded * page.uncompressed for _, _, page, coded in copied) > most:
        for where, chunk, dictionary, coded in copied:
            sums["bytes decoded"] += coded * _longest(where, data, chunk, dictionary)
            _check(where, sums, limits)


_NOT_PLAIN = (
    "{} is not of plain values without a dictionary, so that its decoded size has no bound; write the file "
    "with write_scenarios"
)
_UNBOUNDED = (
    "{} is of an encoding whose decoded size has no bound; write the file again with pyarrow's own encodings"
)


def _is_plain(page: Page) -> bool:
    return not page.dictionary and page.encoding in (PLAIN, BYTE_STREAM_SPLIT)


def _check(where: str, sums: dict[str, int], limits: dict[str, int]) -> None:
    for unit, limit in limits.items():
        if sums[unit] > limit:
            raise ScenarioError(_too_much(where, sums[unit], unit, limit))


def _too_much(where: str, size: int, unit: str, limit: int) -> str:
    return (
        f"{where}: up to here the file holds {size} {unit}; the limit is {limit}. Leave out fingerprint "
        "frames, or split the dataset"
    )


def _longest(where: str, data: Any, chunk: Chunk, dictionary: Page) -> int:
    """Returns the length of a dictionary's longest entry."""
    packed = data[dictionary.at : dictionary.at + dictionary.compressed]
    try:
        codec = CODECS[chunk.codec]
        entries = packed if codec is None else pa.Codec(codec).decompress(packed, dictionary.uncompressed)
    except (KeyError, ValueError, OSError, pa.ArrowException) as err:
        raise ScenarioError(
            f"{where}: its dictionary cannot be read ({err!r:.100}); fetch the file again"
        ) from None
    entries, longest, at = memoryview(entries), 0, 0
    for _ in range(dictionary.values):
        length = int.from_bytes(entries[at : at + 4], "little")
        longest, at = max(longest, length), at + 4 + length
        if at > len(entries):
            raise ScenarioError(f"{where}: its dictionary ends early; fetch the file again")
    return longest


def _fixed_bytes(kind: pa.DataType, slots: int, values: int) -> int:
    """Returns a bound of the bytes that lists of a fixed size take, in all levels of a type.

    Args:
        kind: of a column, or of what it holds.
        slots: elements of that type.
        values: in the whole file: elements of a list whose size is not fixed are no more.
    """
    if isinstance(kind, pa.BaseExtensionType):
        return _fixed_bytes(kind.storage_type, slots, values)
    fixed = pa.types.is_fixed_size_list(kind)
    if fixed:
        slots *= kind.list_size
    elif not pa.types.is_struct(kind):
        slots = values
    inner = sum(_fixed_bytes(kind.field(i).type, slots, values) for i in range(kind.num_fields))
    return inner + (slots * _VALUE_BYTES if fixed else 0)
