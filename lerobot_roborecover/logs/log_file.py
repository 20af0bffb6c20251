"""Opens trial logs for reading: plain, gzip or Zstandard. What is not such a file is refused with the remedy.

Decompressed data is read a line at a time, so that a small file cannot fill the memory.
"""

from __future__ import annotations

import gzip
import io
import os
import stat
import zlib
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol

LOG_SUFFIXES = (".jsonl", ".jsonl.gz", ".jsonl.zst")
TRIALS_FILE = "trials.jsonl"
"""What a run calls its log, where the user names none."""
"""Names of trial logs in a folder."""
_GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_HEAD_BYTES = 2**16


def videos_of_run(log: Path, config_hash: str) -> Path:
    """Folder of the videos of one protocol's trials, beside a log that several policies may share."""
    return log.with_name(f"videos_{config_hash[:8]}")


class LogFileError(ValueError):
    """A file cannot be read as a trial log; the message says what it is and the remedy."""


class LogTextError(LogFileError):
    """Its text is no log's from the first line on."""


class _Source(Protocol):
    def read(self, size: int, /) -> bytes: ...


class _Bytes(io.RawIOBase):
    """The bytes of a stream that is read once, from its start; remembers the last one."""

    def __init__(self, source: _Source):
        self._source, self._position, self.last = source, 0, b""

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        if self._position or offset or whence != os.SEEK_SET:
            raise io.UnsupportedOperation("a compressed log is read once, from its start")
        return 0

    def readinto(self, buffer, /) -> int:
        try:
            data = self._source.read(len(buffer))
        except (EOFError, OSError, ValueError, zlib.error) as err:
            raise LogFileError(
                f"its compressed data is damaged or cut short ({str(err)[:200]}). Fetch it again"
            ) from None
        buffer[: len(data)] = data
        self._position += len(data)
        self.last = data[-1:] or self.last
        return len(data)


class LogReader:
    """An open log.

    Args:
        file: its decompressed bytes, to be read from the start.
        raw: where these come from.
    """

    def __init__(self, file: BinaryIO, raw: _Bytes):
        self.file, self._raw = file, raw

    @property
    def cut(self) -> bool:
        """Whether the last line has no end, once all lines are read."""
        return self._raw.last not in (b"\n", b"")


@contextmanager
def open_log(path: Path) -> Generator[LogReader]:
    """Opens a log for reading.

    Raises:
        OSError: it cannot be opened.
        LogFileError: it is no file of lines in UTF-8.
    """
    _check_regular(path)
    with ExitStack() as stack:
        plain = stack.enter_context(open(path, "rb"))
        magic = plain.read(4)
        plain.seek(0)
        source = _decompressed(plain, magic, stack)
        raw = _Bytes(source)
        file = stack.enter_context(io.BufferedReader(raw, _HEAD_BYTES))
        if problem := text_problem(file.peek(_HEAD_BYTES)):
            raise LogTextError(problem)
        yield LogReader(file, raw)


def appendable(path: Path) -> None:
    """Checks that rows can be added to a file, if there is one.

    Raises:
        LogFileError: it is something else than a plain file of lines.
    """
    try:
        _check_regular(path)
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        return
    if head.startswith((_GZIP, _ZSTD)):
        raise LogFileError(
            "it is compressed, which is read and not added to. Decompress it (gunzip or unzstd), or name "
            "another log"
        )
    if problem := text_problem(head):
        raise LogTextError(problem)


def text_problem(head: bytes) -> str:
    """Returns what is wrong with a log that begins so, and the remedy; empty for nothing."""
    if head.startswith(b"\xef\xbb\xbf"):
        return "it begins with a byte-order mark. Remove it: tail -c +4 LOG > NEW"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")) or head[1:4:2] == b"\0\0" or head[0:3:2] == b"\0\0":
        return "it is UTF-16 text, and a log is UTF-8. Convert it: iconv -f UTF-16 -t UTF-8 LOG > NEW"
    if head.lstrip().startswith(b"["):
        return "it is a JSON array, and a log has one JSON object a line. Convert it: jq -c '.[]' LOG > NEW"
    if b"\r" in head and b"\n" not in head:
        return r"its lines end in carriage returns alone. Convert it: tr '\r' '\n' < LOG > NEW"
    return ""


def _check_regular(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode) and not path.is_dir():
        raise LogFileError("it is not a regular file. Write what it gives to a file, and name that")


def _decompressed(plain: BinaryIO, magic: bytes, stack: ExitStack) -> _Source:
    if magic.startswith(_GZIP):
        return stack.enter_context(gzip.GzipFile(fileobj=plain))
    if magic == _ZSTD:
        import pyarrow as pa

        return stack.enter_context(pa.CompressedInputStream(pa.PythonFile(plain, "r"), "zstd"))
    return plain
