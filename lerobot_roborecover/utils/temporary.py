"""Temporary folders that do not outlive their process: it removes them itself, and the next run removes those
of a process that was killed.

A process holds a lock on its folder, which the system releases with the process however that ends. A folder
that can be locked is therefore abandoned.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import weakref
from pathlib import Path

PREFIX, SUFFIX = "roborecover-", ".tmp"


class TemporaryFolder:
    """A new folder, removed by `close`, at the end of a `with`, or when the process ends.

    Args:
        kind: what it is for; a part of its name.
        parent: folder to make it in; None takes the system's temporary folder.
        prefix: first part of its name.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, kind: str, parent: Path | None = None, prefix: str = PREFIX):
        parent = Path(tempfile.gettempdir()) if parent is None else parent
        remove_abandoned(parent, prefix)
        self.path, lock = _make(parent, f"{prefix}{kind}-")
        self._remove = weakref.finalize(self, _remove, self.path, lock, os.getpid())

    def close(self) -> None:
        self._remove()

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()


def remove_abandoned(parent: Path, prefix: str = PREFIX) -> list[Path]:
    """Removes temporary folders whose processes have ended.

    Args:
        parent: where to look.
        prefix: of their names.

    Returns:
        What was removed.
    """
    gone = []
    for path in sorted(parent.glob(f"{prefix}*{SUFFIX}")):
        try:
            if path.is_symlink() or path.stat().st_uid != os.getuid():
                continue
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError:
            continue  # not a folder, or another process was first
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path)
            gone.append(path)
        except OSError:
            pass  # in use, or a file system without locks: nothing says that it is abandoned
        finally:
            os.close(lock)
    return gone


def _make(parent: Path, prefix: str) -> tuple[Path, int]:
    """Makes a folder; returns it and the descriptor that holds its lock."""
    while True:
        path = Path(tempfile.mkdtemp(SUFFIX, prefix, parent))
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue  # another process took it for abandoned before it was opened
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError:
            return path, lock  # a file system without locks, where no other process removes it either
        if path.exists():
            return path, lock
        os.close(lock)  # another process took it for abandoned before it was locked


def _remove(path: Path, lock: int, process: int) -> None:
    if os.getpid() != process:  # a fork of the owner
        return
    shutil.rmtree(path, ignore_errors=True)
    os.close(lock)
