"""Append-only JSON-lines files whose records are on disk before anything else happens.

`AppendOnly` is the file itself. One process at a time holds it, and a line is on disk when `append` returns.
The next opening drops a last line that a crash has cut off, and keeps every complete line. The lines' content
is up to the caller:

- `Journal`: votes, decisions, rollouts; records with a schema version.
- the trial log: checked rows.
- `datasets.fingerprint`: replays by key.
"""

from __future__ import annotations

import fcntl
import json
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Self

from lerobot_roborecover.errors import InUseError, ScenarioError, naming
from lerobot_roborecover.utils.atomic_io import atomic_file, sync_folder
from lerobot_roborecover.utils.file_locks import LockResult, is_still_at, lock_file

MAX_JOURNAL_BYTES = 2**28
_BLOCK = 2**16


def open_locked(path: Path, mode: str) -> IO[Any]:
    """Opens a file for this process alone, until it is closed; its folder is made if need be.

    Raises:
        OSError: it cannot be opened.
        InUseError: another process has it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        file = open(path, mode)  # noqa: SIM115 - the caller closes it
        try:
            if lock_file(file, fcntl.LOCK_EX | fcntl.LOCK_NB) is LockResult.IN_USE:
                raise InUseError(f"{path} is in use by another process")
            if is_still_at(file, path):
                return file
        except BaseException:
            file.close()
            raise
        # Another process has put a new file in its place between the opening and the lock.
        file.close()


class AppendOnly:
    """An open file of lines that takes more; only one process may hold it.

    Args:
        path: the file; it and its folder are made if need be.

    Raises:
        OSError: it cannot be opened.
        InUseError: another process has it.
    """

    def __init__(self, path: Path):
        self.path = path
        self._file = open_locked(path, "a+b")
        # A file that was just made is only there after a crash once its folder is on disk, too.
        sync_folder(path.parent)

    def lines(self, longest: int | None = None) -> Iterator[bytes]:
        """See `complete_lines`."""
        return complete_lines(self._file, longest)

    def cut(self) -> int:
        """Drops an incomplete last line, left by a crash, and returns its number of bytes.

        The caller must read the file first: a file of another kind must not be cut.
        """
        number = self._file.fileno()
        size = end = os.fstat(number).st_size
        while end:
            first = max(end - _BLOCK, 0)
            found = os.pread(number, end - first, first).rfind(b"\n")
            if found >= 0:
                end = first + found + 1
                break
            end = first
        if end < size:
            os.ftruncate(number, end)
        return size - end

    def append(self, *lines: bytes) -> None:
        """Adds lines; they are on disk when this returns.

        Args:
            lines: without their ends.

        Raises:
            OSError: they could not be written; the file is as it was.
        """
        data = b"".join(line + b"\n" for line in lines)
        number = self._file.fileno()
        size = os.fstat(number).st_size
        try:
            # Without a buffer: after a full disk, nothing of it may come later.
            with naming(self.path):
                written = 0
                while written < len(data):
                    written += os.write(number, data[written:])
                os.fsync(number)
        except OSError:
            os.ftruncate(number, size)
            raise

    def replace(self, lines: Iterable[bytes]) -> None:
        """Replaces all lines; the file is locked throughout, and a crash leaves the old or the new lines.

        Args:
            lines: without their ends.

        Raises:
            OSError: they could not be written; the file is as it was.
        """
        with ExitStack() as stack:
            with atomic_file(self.path, held=self._file) as temporary:
                # Locked before it has the file's name, so that no other process can be first.
                file = stack.enter_context(open_locked(temporary, "a+b"))
                file.writelines(line + b"\n" for line in lines)
                file.flush()
            stack.pop_all()
        old, self._file = self._file, file
        old.close()

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def complete_lines(file: IO[bytes], longest: int | None = None) -> Iterator[bytes]:
    """Lines with their ends, from the start of a file; a last one without its end is left out.

    Args:
        file: open for reading.
        longest: bytes of a line at most; a longer line is yielded cut, for the reader to refuse.
    """
    file.seek(0)
    limit = -1 if longest is None else longest + 2
    while (line := file.readline(limit)).endswith(b"\n") or (longest is not None and len(line) > longest):
        yield line


def append_records(path: Path, *records: Mapping[str, Any]) -> None:
    """Appends plain records to a file that no process keeps open; drops an incomplete last line.

    Raises:
        OSError: they could not be written; the file is as it was.
        InUseError: another process has it.
    """
    with AppendOnly(path) as file:
        file.cut()
        file.append(*(json.dumps(r).encode() for r in records))


def plain_records(path: Path) -> list[dict[str, Any]]:
    """What `append_records` has written; nothing where there is no file."""
    try:
        with open(path, "rb") as file:
            return [json.loads(line) for line in complete_lines(file)]
    except FileNotFoundError:
        return []


def parse_records(data: bytes, where: str, schema: int) -> list[dict[str, Any]]:
    """Complete records of a journal; a last line without its newline is a crash's leftover.

    Args:
        data: the file's bytes.
        where: names the file in messages.
        schema: latest schema version that the caller reads.

    Raises:
        ScenarioError: a complete line is not a JSON object of a known schema.
    """
    records = []
    for number, line in enumerate(data.split(b"\n")[:-1], 1):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as err:
            raise ScenarioError(
                f"{where}, line {number}: not a JSON record ({err!s:.200}). Only a last line can be cut off "
                "by a crash; this one is damaged. Restore the file from a copy, or remove the line"
            ) from None
        version = record.get("schema") if isinstance(record, dict) else None
        if type(version) is not int or not 1 <= version <= schema:
            raise ScenarioError(
                f"{where}, line {number}, field schema: {version!r:.80}; this version reads 1 to {schema}. "
                "Upgrade this package: pip install -U lerobot_env_roborecover"
            )
        records.append(record)
    return records


def read_journal(path: Path, schema: int) -> list[dict[str, Any]]:
    """Complete records of a journal on disk; none where there is no file.

    Raises:
        ScenarioError: the file is no journal, or larger than `MAX_JOURNAL_BYTES`.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_JOURNAL_BYTES:
            raise ScenarioError(
                f"{path} is not a regular file of at most {MAX_JOURNAL_BYTES} bytes; put the journal itself "
                "in its place"
            )
        return parse_records(path.read_bytes(), str(path), schema)
    except FileNotFoundError:
        return []
    except OSError as err:
        raise ScenarioError(f"{path} cannot be read: {err}. Check its permissions") from err


class Journal:
    """An open journal that takes records; only one process may hold it.

    Args:
        path: the file; its folder is made if need be.
        schema: version of the records.

    Raises:
        ScenarioError: the journal is damaged, cannot be written, or another process has it open.
    """

    def __init__(self, path: Path, schema: int):
        self.path, self._schema = path, schema
        try:
            self._file = AppendOnly(path)
        except OSError as err:
            raise ScenarioError(f"{path} cannot be written: {err}. Name a folder that you may write") from err
        except InUseError as err:
            raise ScenarioError(f"{err}; stop that one first") from None
        try:
            self.records = parse_records(b"".join(self._file.lines()), str(path), schema)
        except ScenarioError:
            self._file.close()
            raise
        self._file.cut()

    def append(self, *records: Mapping[str, Any]) -> None:
        """Adds records; they are on disk when this returns.

        Raises:
            ScenarioError: they could not be written; the file is as it was.
        """
        whole = [{"schema": self._schema, **record} for record in records]
        try:
            self._file.append(*(json.dumps(r, allow_nan=False).encode() for r in whole))
        except OSError as err:
            raise ScenarioError(f"{self.path} could not be written: {err}. Make room on the disk") from err
        self.records += whole

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
