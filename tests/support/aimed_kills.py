"""Runs a piece of work again and again, killed at its first file-system operation, its second, and so on.

    python -m tests.support.aimed_kills WORK SOURCE FOLDER

WORK is `module:function`, called with a copy of SOURCE at FOLDER/N/NAME; the copy of the N-th run stays
as the kill left it. The last run is not killed. Clocks that files hold stand still.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

_EVENTS = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink")
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class _StandingClock(datetime):
    @classmethod
    def now(cls, tz=None):
        return datetime(2026, 1, 2, tzinfo=UTC)


def kill_at(operation: int, folder: Path) -> None:
    """Kills this process just before its n-th operation that changes something in a folder."""
    inside, left = str(folder), operation

    def count(event: str, arguments: tuple) -> None:
        nonlocal left
        if event not in _EVENTS and not (event == "open" and (arguments[2] or 0) & _WRITES):
            return
        path = os.fspath(arguments[0]) if isinstance(arguments[0], str | os.PathLike) else ""
        # A tree is removed by names relative to open folders.
        if path.startswith(inside) or not os.path.isabs(path):
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)


def run(work: Callable[[Path], object], source: Path, folder: Path) -> int:
    """Runs the work, killed at each of its operations in turn; returns how many it has."""
    shutil.copytree(source, folder / "imports" / source.name)
    work(folder / "imports" / source.name)  # so that no child imports anything again
    operation = 0
    while True:
        copy = folder / f"{operation:04d}" / source.name
        shutil.copytree(source, copy)
        child = os.fork()
        if not child:
            status = 1
            try:
                kill_at(operation, copy.parent)
                work(copy)
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)
        status = os.waitpid(child, 0)[1]
        if not os.WIFSIGNALED(status):
            if os.waitstatus_to_exitcode(status):
                sys.exit(f"the work failed at operation {operation}")
            return operation
        operation += 1


if __name__ == "__main__":
    from lerobot_roborecover.curation import funnel

    funnel.datetime = _StandingClock
    os.fsync = lambda number: None  # a kill loses nothing that was written
    module, _, function = sys.argv[1].partition(":")
    print(run(getattr(importlib.import_module(module), function), Path(sys.argv[2]), Path(sys.argv[3])))
