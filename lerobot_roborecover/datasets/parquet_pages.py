"""Lists the pages of a parquet file from its own headers, without decoding any of them.

The footer and the page headers are Thrift's compact protocol; they are read here, because pyarrow's accessors
end the whole process on some malformed statistics, and because the Arrow reader believes each page's header.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

MAX_FOOTER_BYTES = 2**24

BYTE_ARRAY, FIXED_LENGTH = 6, 7
PLAIN, BYTE_STREAM_SPLIT = 0, 9
DICTIONARY = {2, 8}
"""Encodings whose values are numbers of entries in the dictionary page."""
ENCODINGS = {PLAIN, 3, 4, 5, 6, BYTE_STREAM_SPLIT} | DICTIONARY
"""Encodings whose decoded size has a bound: all but DELTA_BYTE_ARRAY, where values share beginnings."""
CODECS = {0: None, 1: "snappy", 2: "gzip", 4: "brotli", 6: "zstd", 7: "lz4_raw"}

# Field numbers of the Thrift structs that are read here:
# https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift
_SCHEMA, _ROWS, _ROW_GROUPS = 2, 3, 4
_ELEMENT_TYPE, _ELEMENT_LENGTH, _CHILDREN = 1, 2, 5
_COLUMNS, _GROUP_ROWS, _META_DATA = 1, 3, 3
_PATH, _CODEC, _CHUNK_VALUES, _CHUNK_BYTES, _DATA_PAGE_AT, _DICTIONARY_PAGE_AT = 3, 4, 5, 7, 9, 11
_PAGE_TYPE, _UNCOMPRESSED, _COMPRESSED = 1, 2, 3
_NUM_VALUES, _COMPRESSED_V2 = 1, 7
_DICTIONARY_PAGE = 2
_PAGE_HEADERS = {0: (5, 2), _DICTIONARY_PAGE: (7, 2), 3: (8, 4)}
"""Page type to (field of its own header, field of the encoding in that): data pages of version 1 and 2, and
the dictionary."""


class PagesError(ValueError):
    """Headers that no parquet writer writes."""


@dataclass(frozen=True)
class Page:
    """One page, as its header describes it."""

    at: int
    """Where its bytes begin, after the header."""
    compressed: int
    uncompressed: int
    values: int
    encoding: int
    dictionary: bool


@dataclass(frozen=True)
class Chunk:
    """One column of one row group."""

    name: str
    kind: int
    """Physical type, from the schema: the reader ignores what the chunk says."""
    width: int
    """Bytes of a value of fixed length; 0 otherwise."""
    codec: int
    rows: int
    values: int
    """As the footer has it; the reader makes room for as many."""
    start: int
    end: int

    def pages(self, data: Any) -> Iterator[Page]:
        """Yields the pages in order.

        Args:
            data: the file, as bytes or a memory map.

        Raises:
            PagesError: a header is malformed.
        """
        at = self.start
        while at < self.end:
            try:
                header, after = _read_struct(data, at)
                own, encoding = _PAGE_HEADERS.get(header[_PAGE_TYPE], (0, 0))
                page = Page(
                    after,
                    header[_COMPRESSED],
                    header[_UNCOMPRESSED],
                    header[own][_NUM_VALUES] if own else 0,
                    header[own][encoding] if own else -1,
                    header[_PAGE_TYPE] == _DICTIONARY_PAGE,
                )
                if not _whole(page.compressed, page.uncompressed, page.values):
                    raise TypeError("not a size")
            except (IndexError, KeyError, TypeError, RecursionError) as err:
                raise PagesError(
                    f"field {self.name} has a malformed page at byte {at} ({err!r:.100}); fetch it again"
                ) from err
            at = after + page.compressed
            yield page


def read_chunks(data: Any) -> list[Chunk]:
    """Returns every column chunk of a file.

    Args:
        data: the file, as bytes or a memory map.

    Raises:
        PagesError: the footer is malformed, or contradicts itself.
    """
    size = len(data)
    if size < 12 or data[:4] != b"PAR1" or data[-4:] != b"PAR1":
        raise PagesError(f"{size} bytes that are not a complete parquet file; fetch the file again")
    length = int.from_bytes(data[-8:-4], "little")
    if length > min(MAX_FOOTER_BYTES, size - 12):
        raise PagesError(f"the footer claims {length} bytes of {size}; the limit is {MAX_FOOTER_BYTES}")
    try:
        footer, _ = _read_struct(data, size - 8 - length)
        leaves = [e for e in footer[_SCHEMA] if _ELEMENT_TYPE in e and not e.get(_CHILDREN)]
        chunks = []
        for group in footer[_ROW_GROUPS]:
            for leaf, column in zip(leaves, group[_COLUMNS], strict=True):
                chunks.append(_chunk(leaf, column[_META_DATA], group[_GROUP_ROWS], size))
        if footer[_ROWS] != sum(group[_GROUP_ROWS] for group in footer[_ROW_GROUPS]):
            raise ValueError("rows do not add up")
    except PagesError:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, RecursionError) as err:
        raise PagesError(f"a malformed footer ({err!r:.100}); fetch the file again") from err
    return chunks


def _chunk(leaf: dict[int, Any], column: dict[int, Any], rows: int, size: int) -> Chunk:
    start = column[_DATA_PAGE_AT]
    dictionary = column.get(_DICTIONARY_PAGE_AT, 0)
    start = dictionary if 0 < dictionary < start else start
    # Without a value nothing is read, and the positions of a chunk are those of no page.
    length = column[_CHUNK_BYTES] if column[_CHUNK_VALUES] else 0
    chunk = Chunk(
        ".".join(name.decode() for name in column[_PATH]),
        leaf[_ELEMENT_TYPE],
        leaf.get(_ELEMENT_LENGTH, 0) if leaf[_ELEMENT_TYPE] == FIXED_LENGTH else 0,
        column[_CODEC],
        rows,
        column[_CHUNK_VALUES],
        start,
        start + length,
    )
    if not _whole(chunk.width, rows, chunk.values, start, length, chunk.kind):
        raise TypeError("not a size")
    if chunk.end > size:
        raise PagesError(
            f"field {chunk.name} lies at bytes {start} to {chunk.end} of {size}; fetch the file again"
        )
    if rows > chunk.values:
        raise PagesError(f"field {chunk.name} has {chunk.values} values for {rows} rows; fetch it again")
    return chunk


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
