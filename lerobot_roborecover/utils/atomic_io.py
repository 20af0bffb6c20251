"""Writes files and folders atomically: they appear complete, on disk, or not at all.

Each is first written as `.NAME.PROCESS.tmp` beside its final place. A killed process leaves this behind; the
next process that writes NAME removes it. A lock (`.NAME.PROCESS.lock`) shows that a process still writes a
folder; the system releases the lock when the process ends, on any machine. For file systems without locks,
the lock file also names the machine and the process's start time.
"""

from __future__ import annotations

import errno
import fcntl
import glob
import os
import re
import shutil
import socket
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any

from lerobot_roborecover.errors import InUseError, ScenarioError, naming
from lerobot_roborecover.utils.file_locks import LockResult, is_still_at, lock_file

_DEAD_AFTER_S = 7 * 86400


@contextmanager
def atomic_file(path: Path, held: IO[Any] | None = None) -> Generator[Path]:
    """A name beside `path`; what the block writes there takes its place when the block ends well.

    Args:
        path: the file. A file that a process has locked, such as a log in use, is never replaced.
        held: the open file at `path`, where this process has locked it itself.

    Raises:
        InUseError: another process has locked `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if held is None:
        check_unlocked(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    _forget_files(path)
    try:
        with naming(path):
            yield temporary
            _to_disk(temporary)
        with nullcontext() if held is not None else _lock_existing(path):
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    # The name is only there after a crash once its folder is on disk, too.
    sync_folder(path.parent)


def check_unlocked(path: Path) -> None:
    """Checks that no process has locked a file; one that does not exist is not locked.

    Raises:
        InUseError: a process has locked it.
    """
    with _lock_existing(path):
        pass


@contextmanager
def _lock_existing(path: Path) -> Generator[None]:
    """Holds a file's lock, so that no process begins to write a file that is about to be replaced.

    The lock is shared: who replaces the same file at the same moment is not in the way, the last one wins.

    Raises:
        InUseError: another process has the file for itself, such as a log that it writes.
    """
    with ExitStack() as stack:
        # Neither a device nor a FIFO is opened: that can block.
        while path.is_file():
            try:
                file = stack.enter_context(open(path, "rb"))
            except OSError:
                break  # not readable: no run of this user has it open
            if lock_file(file, fcntl.LOCK_SH | fcntl.LOCK_NB) is LockResult.IN_USE:
                raise InUseError(
                    f"{path} is in use by another process and is not replaced. Wait for that process, or "
                    "name another file"
                )
            if is_still_at(file, path):
                break
        yield


def atomic_write(path: Path, data: str | bytes) -> None:
    """Writes a file, text as UTF-8; it is on disk when this returns."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def check_new(root: Path) -> None:
    """Checks that a folder can be written: that it does not exist, or is empty.

    Raises:
        ScenarioError: it is not.
    """
    if root.is_symlink() or (root.exists() and (not root.is_dir() or any(root.iterdir()))):
        raise ScenarioError(f"{root} is not an empty folder; name a new one")


@contextmanager
def atomic_dir(root: Path, *, replace: bool = False) -> Generator[Path]:
    """A name beside `root`, not made yet, whose folder takes root's place when the block ends well.

    Args:
        root: where it belongs.
        replace: whether it may take the place of an earlier folder, which is deleted then.

    Raises:
        ScenarioError: `root` is not new or empty, and must be.
    """
    root.parent.mkdir(parents=True, exist_ok=True)
    remove_stale(root)
    if not replace:
        check_new(root)
    temporary, old, lock = (
        root.with_name(f".{root.name}.{os.getpid()}.{kind}") for kind in ("tmp", "old", "lock")
    )
    with open(lock, "a") as held:
        try:
            lock_file(held, fcntl.LOCK_EX)
            held.write(_identity(os.getpid()))
            held.flush()
            shutil.rmtree(temporary, ignore_errors=True)
            yield from _at(root, temporary, old, replace)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)
            lock.unlink(missing_ok=True)


def _at(root: Path, temporary: Path, old: Path, replace: bool) -> Iterator[Path]:
    with naming(root):
        yield temporary
    if root.exists() and not replace:
        root.rmdir()
    elif root.exists():
        os.replace(root, old)
    try:
        os.replace(temporary, root)
    except BaseException:
        if old.exists():
            os.replace(old, root)
        raise


def remove_stale(root: Path) -> list[Path]:
    """Takes away what killed writers of a folder have left beside it.

    An earlier folder that was on its way out when its writer was killed comes back, where none has taken its
    place.

    Args:
        root: where the folder belongs.

    Returns:
        What was taken away.
    """
    if not root.parent.is_dir():
        return []
    # A writer within a writer has `..NAME.1.tmp.1.tmp`.
    left = re.compile(rf"\.+{re.escape(root.name)}((?:\.[0-9]+\.tmp)*)\.([0-9]+)\.(tmp|old|lock)")
    leftovers = [(path, m) for path in sorted(root.parent.iterdir()) if (m := left.fullmatch(path.name))]
    # Asked once for each writer, while its lock file is still there.
    writers = {path.with_suffix(".lock"): int(found[2]) for path, found in leftovers}
    at_work = {lock for lock, process in writers.items() if _at_work(lock, process)}
    gone = []
    for path, found in leftovers:
        if path.with_suffix(".lock") in at_work:
            continue
        if found[3] == "old" and not found[1] and not root.exists():
            os.replace(path, root)
        elif path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        gone.append(path)
    return gone


def _at_work(lock: Path, process: int) -> bool:
    """Whether the writer that made a lock file is at work.

    A lock that is held says so. Without a lock file, the writer's process on this machine decides; without
    locks in the file system, whether that process is still the one that made the file. A writer of another
    machine, which cannot be asked then, counts as dead after `_DEAD_AFTER_S`.
    """
    try:
        with open(lock, encoding="utf-8", errors="replace") as file:
            result = lock_file(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            if result is not LockResult.UNSUPPORTED:
                return result is LockResult.IN_USE
            made_by, age_s = file.read(), time.time() - os.fstat(file.fileno()).st_mtime
    except FileNotFoundError:
        return process != os.getpid() and _lives(process)
    except OSError:
        return True
    host = f"{socket.gethostname()}\n"
    if not made_by.startswith(host):
        return age_s < _DEAD_AFTER_S
    return process != os.getpid() and _lives(process) and _identity(process) in (made_by, host)


def _identity(process: int) -> str:
    """Names a process of this machine, so that a later one with the same number is distinguished from it."""
    try:
        # Field 22 is when it began; the name in field 2 may hold spaces and brackets.
        began = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        began = ""  # no /proc: its number alone
    return f"{socket.gethostname()}\n{began}"


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass
    return True


def _forget_files(path: Path) -> None:
    """Takes away what killed writers of a file have left; no file takes an hour to write."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        process = left.name.removeprefix(f".{path.name}.").removesuffix(".tmp")
        try:
            if process.isdigit() and time.time() - left.stat().st_mtime > 3600 and not _lives(int(process)):
                left.unlink(missing_ok=True)
        except OSError:
            continue  # another process was first


def sync_folder(path: Path) -> None:
    """Waits until a folder's names are on disk, where its file system can say so."""
    try:
        _to_disk(path)
    except OSError as err:
        # Some network file systems cannot sync a folder; SQLite goes on there as well.
        if err.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):
            raise


def _to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
