"""A child process that does not outlive its parent, whatever ended that, `kill -9` included."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from functools import partial

_PR_SET_PDEATHSIG = 1
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
