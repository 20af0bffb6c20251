"""Locks files between processes, and goes on without a lock where the file system has none.

Lustre without `-o flock`, some NFS mounts and some containers answer every `flock` with an error. As in git
and SQLite, that is no reason to refuse work: the user is warned that concurrent runs are not kept apart.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
from enum import Enum
from functools import cache
from pathlib import Path
from typing import IO, Any

logger = logging.getLogger(__name__)

_IN_USE = (errno.EWOULDBLOCK, errno.EAGAIN)
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)


class LockResult(Enum):
    """What an attempt to lock a file gave."""

    HELD = "held"
    IN_USE = "in use"
    """Another process, or another open file of this process, holds the lock."""
    UNSUPPORTED = "unsupported"
    """The file system has no locks."""


def lock_file(file: IO[Any], operation: int) -> LockResult:
    """Locks an open file until it is closed.

    Args:
        file: any open file.
        operation: `fcntl.LOCK_EX` or `fcntl.LOCK_SH`; with `fcntl.LOCK_NB`, does not wait.

    Raises:
        OSError: the lock fails for another reason than being held or being unsupported.
    """
    try:
        fcntl.flock(file, operation)
    except OSError as err:
        if err.errno in _IN_USE:
            return LockResult.IN_USE
        if err.errno in _NO_LOCKS:
            _warn_once(os.fstat(file.fileno()).st_dev, os.path.dirname(os.path.abspath(file.name)), str(err))
            return LockResult.UNSUPPORTED
        raise OSError(err.errno, err.strerror, file.name) from None
    return LockResult.HELD


def is_still_at(file: IO[Any], path: Path) -> bool:
    """Returns whether a path still names an open file, rather than another one put in its place."""
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return False
    return os.path.samestat(found, os.fstat(file.fileno()))


@cache
def _warn_once(device: int, folder: str, reason: str) -> None:
    """Warns once for each file system."""
    logger.warning(
        "%s: its file system has no file locks (%s), so runs that write the same files are not kept apart; "
        "start one at a time",
        folder,
        reason,
    )
