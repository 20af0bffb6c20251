"""Child processes: one that does not outlive its parent, whatever ended that, and how a child is stopped."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from functools import partial

_PR_SET_PDEATHSIG = 1
_TOLD_S, _END_S = 2.0, 30.0
"""How long a child may take to end that was told to by the terminal, and by SIGTERM."""
# Loaded here and not when it is needed: between fork and exec little is safe.
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def end_with_parent(parent: int) -> None:
    """Has the kernel kill this process when its parent ends; the order survives an exec.

    The kernel means the parent's *thread* that started this process. Elsewhere than on Linux this does
    nothing, and a child has to notice by itself.

    Args:
        parent: the parent's process id; if it has ended already, so does this process.
    """
    if _LIBC is None:
        return
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def ends_with_this() -> Callable[[], None]:
    """`preexec_fn` of a child that is not to outlive this process."""
    return partial(end_with_parent, os.getpid())


def stop_children(processes: Collection[subprocess.Popen]) -> None:
    """Stops children in good order, and kills those that do not end.

    Ctrl-C in a terminal reaches the children as well, so they are given a moment before they are told again.
    """
    _wait(processes, _TOLD_S)
    for process in processes:
        process.terminate()  # does nothing to one that has ended
    _wait(processes, _END_S)
    for process in processes:
        process.kill()
        process.wait()


def _wait(processes: Iterable[subprocess.Popen], patience_s: float) -> None:
    deadline = time.monotonic() + patience_s
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(deadline - time.monotonic(), 0.0))
