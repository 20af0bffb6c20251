"""Gives freed memory back to the system: compiling a task takes far more than the task then needs."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable


def _find_trim() -> Callable[[int], int] | None:
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's; musl has none


_TRIM = _find_trim()


def release_freed_memory() -> None:
    """Has the allocator return what it keeps for later; does nothing where it cannot be known."""
    if _TRIM is not None:
        gc.collect()
        _TRIM(0)
