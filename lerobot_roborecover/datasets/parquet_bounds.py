"""Bounds what decoding an untrusted parquet takes, before any of it is decoded.

A few bytes of parquet can stand for gigabytes: compressed pages, dictionary entries repeated by run lengths,
nulls. Scenario files hold never-null values as they are, at most sorted by byte, so that their decoded size
is their uncompressed size; this module insists on that and on the size. The sizes in a footer can lie, and
the Arrow reader believes each page's own header, so the page headers are what is added up here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.schema import MAX_SCENARIOS, MAX_UNCOMPRESSED_BYTES, SCHEMA
from lerobot_roborecover.scenario import ScenarioError

MAX_FOOTER_BYTES = 2**24
MAX_PAGES = 2**20
MAX_VALUES = MAX_UNCOMPRESSED_BYTES // 8

# Field numbers of the Thrift structs that are read here:
# https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift
_ROW_GROUPS, _COLUMNS, _META_DATA = 4, 1, 3
_PATH, _CHUNK_BYTES, _DATA_PAGE_AT, _DICTIONARY_PAGE_AT = 3, 7, 9, 11
_TYPE, _UNCOMPRESSED, _COMPRESSED = 1, 2, 3
_NUM_VALUES = 1
_DATA_PAGES = {0: (5, 2), 3: (8, 4)}
"""Page type to (field of its own header, field of the encoding in that): data pages of version 1 and 2."""
_AS_THEY_ARE = {0, 9}
"""Encodings that change no value's size: PLAIN and BYTE_STREAM_SPLIT."""


def check_bounds(path: Path, data: bytes, schema: pa.Schema = SCHEMA) -> None:
    """Checks columns, row count, encodings and uncompressed sizes.

    Args:
        path: for messages only.
        data: the whole file.
        schema: columns that it must have.

    Raises:
        ScenarioError: a column is missing or of another type, or a bound is exceeded.
        pyarrow.ArrowException, OSError, ValueError: the file is not decodable at all.
    """
    file = pq.ParquetFile(pa.BufferReader(data))
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
    sizes = {"pages": 0, "values": 0, "bytes uncompressed": 0}
    # Every column, also those that the schema does not name: what a column is called here and which one the
    # Arrow reader takes it for need not agree.
    for column in _columns(path, data):
        _add_pages(path, data, column, sizes)


def _columns(path: Path, data: bytes) -> list[dict[int, Any]]:
    """The metadata of every column chunk, by field number.

    Read from the footer here, because pyarrow's accessors end the whole process on some malformed statistics.
    """
    length = int.from_bytes(data[-8:-4], "little")
    if length > min(MAX_FOOTER_BYTES, len(data) - 12):
        raise ScenarioError(
            f"{path}: the footer claims {length} bytes of {len(data)}; the limit is {MAX_FOOTER_BYTES}"
        )
    try:
        footer, _ = _read_struct(data, len(data) - 8 - length)
        columns = [chunk[_META_DATA] for group in footer[_ROW_GROUPS] for chunk in group[_COLUMNS]]
        for column in columns:
            if not _whole(column[_CHUNK_BYTES], column[_DATA_PAGE_AT]):
                raise TypeError("not a size")
            column[_PATH] = [name.decode() for name in column[_PATH]]
    except (AttributeError, IndexError, KeyError, TypeError, RecursionError) as err:
        raise ScenarioError(f"{path} has a malformed footer ({err!r:.100}); fetch the file again") from err
    return columns


def _add_pages(path: Path, data: bytes, column: dict[int, Any], sizes: dict[str, int]) -> None:
    """Adds the pages, values and uncompressed bytes of one column chunk to `sizes` and checks the sums."""
    where = f"{path}: field {'.'.join(column[_PATH])}"
    not_plain = (
        f"{where} is not of plain values without a dictionary, so that its decoded size has no bound; write "
        "the file with write_scenarios"
    )
    if _DICTIONARY_PAGE_AT in column:
        raise ScenarioError(not_plain)
    at = column[_DATA_PAGE_AT]
    end = at + column[_CHUNK_BYTES]
    if end > len(data):
        raise ScenarioError(f"{where} lies at bytes {at} to {end} of {len(data)}; fetch the file again")
    while at < end:
        try:
            header, after = _read_struct(data, at)
            own, encoding = _DATA_PAGES.get(header[_TYPE], (0, 0))
            if not own or header[own][encoding] not in _AS_THEY_ARE:
                raise ScenarioError(not_plain)
            page = {
                "pages": 1,
                "values": header[own][_NUM_VALUES],
                "bytes uncompressed": header[_UNCOMPRESSED],
            }
            if not _whole(header[_COMPRESSED], *page.values()):
                raise TypeError("not a size")
        except (IndexError, KeyError, TypeError, RecursionError) as err:
            raise ScenarioError(
                f"{where} has a malformed page at byte {at} ({err!r:.100}); fetch the file again"
            ) from err
        at = after + header[_COMPRESSED]
        for (unit, size), limit in zip(
            page.items(), (MAX_PAGES, MAX_VALUES, MAX_UNCOMPRESSED_BYTES), strict=True
        ):
            sizes[unit] += size
            if sizes[unit] > limit:
                raise ScenarioError(
                    f"{where}: up to here the file holds {sizes[unit]} {unit}; the limit is {limit}. Leave "
                    "out fingerprint frames, or split the dataset"
                )


def _whole(*values: object) -> bool:
    return all(type(value) is int and value >= 0 for value in values)


def _read_struct(data: bytes, at: int) -> tuple[dict[int, Any], int]:
    """A struct of Thrift's compact protocol.

    Returns:
        Values by field number, and the position after the struct.

    Raises:
        IndexError: the data ends within it.
        KeyError: it holds a field twice, or a kind of value that parquet metadata does not have.
    """
    fields: dict[int, Any] = {}
    number = 0
    while head := data[at]:
        at += 1
        delta, kind = head >> 4, head & 15
        if delta:
            number += delta
        else:
            number, at = _read_integer(data, at)
        if number in fields:
            raise KeyError(f"field {number} twice")
        if kind in (1, 2):
            fields[number] = kind == 1
        else:
            fields[number], at = _read_value(data, at, kind)
    return fields, at + 1


def _read_value(data: bytes, at: int, kind: int) -> tuple[Any, int]:
    if kind in (1, 2, 3):
        return data[at], at + 1
    if kind in (4, 5, 6):
        return _read_integer(data, at)
    if kind == 8:
        length, at = _read_varint(data, at)
        return data[at : at + length], at + length
    if kind == 9:
        count, kind, at = data[at] >> 4, data[at] & 15, at + 1
        if count == 15:
            count, at = _read_varint(data, at)
        values = []
        for _ in range(count):
            value, at = _read_value(data, at, kind)
            values.append(value)
        return values, at
    if kind == 12:
        return _read_struct(data, at)
    raise KeyError(f"kind {kind}")


def _read_integer(data: bytes, at: int) -> tuple[int, int]:
    value, at = _read_varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
    raise IndexError(at)
