"""Files and folders that appear whole, on disk, or not at all.

Each is written under a name of its own beside its place, `.NAME.PROCESS.tmp`. A process that is killed leaves
that behind; whoever writes NAME next takes it away. That nobody is at work on a folder any more is known by a
lock (`.NAME.PROCESS.lock`), which the system lets go of with the process, on whichever machine it ran.
"""

from __future__ import annotations

import fcntl
import glob
import os
import re
import shutil
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_roborecover.errors import naming
from lerobot_roborecover.scenario import ScenarioError


@contextmanager
def new_file(path: Path) -> Generator[Path]:
    """A name beside `path`; what the block writes there takes its place when the block ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    _forget_files(path)
    try:
        with naming(path):
            yield temporary
            _to_disk(temporary)
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    # The name is only there after a crash once its folder is on disk, too.
    _to_disk(path.parent)


def write_whole(path: Path, data: str | bytes) -> None:
    """Writes a file, text as UTF-8; it is on disk when this returns."""
    with new_file(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def check_new(root: Path) -> None:
    """Checks that a folder can be written: that it does not exist, or is empty.

    Raises:
        ScenarioError: it is not.
    """
    if root.is_symlink() or (root.exists() and (not root.is_dir() or any(root.iterdir()))):
        raise ScenarioError(f"{root} is not an empty folder; name a new one")


@contextmanager
def new_folder(root: Path, *, replace: bool = False) -> Generator[Path]:
    """A name beside `root`, not made yet, whose folder takes root's place when the block ends well.

    Args:
        root: where it belongs.
        replace: whether it may take the place of an earlier folder, which is deleted then.

    Raises:
        ScenarioError: `root` is not new or empty, and must be.
    """
    root.parent.mkdir(parents=True, exist_ok=True)
    forget_stale(root)
    if not replace:
        check_new(root)
    temporary, old, lock = (
        root.with_name(f".{root.name}.{os.getpid()}.{kind}") for kind in ("tmp", "old", "lock")
    )
    shutil.rmtree(temporary, ignore_errors=True)
    with open(lock, "a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        try:
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


def forget_stale(root: Path) -> list[Path]:
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
    gone = []
    for path in sorted(root.parent.iterdir()):
        found = left.fullmatch(path.name)
        if found is None or _at_work(path.with_suffix(".lock"), int(found[2])):
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
    """Whether a writer is at work: it holds its lock, or, without one, lives on this machine."""
    try:
        with open(lock, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
    except FileNotFoundError:
        return process != os.getpid() and _lives(process)
    except OSError:
        return True


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


def _to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
