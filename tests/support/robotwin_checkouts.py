"""Which RoboTwin checkout the tests run on: the one in ROBOTWIN_ROOT, or the stand-in."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest

STANDIN = Path(__file__).parent / "robotwin_standin"
REAL = os.environ.get("ROBOTWIN_ROOT")
ROOT = REAL or str(STANDIN)
TASKS = (
    (
        "stack_blocks_two",
        "stack_blocks_three",
        "blocks_ranking_rgb",
        "blocks_ranking_size",
        "handover_block",
    )
    if REAL
    else ("stack_blocks_two", "blocks_ranking_rgb")
)
"""Tasks that need no object models."""

on_standin = pytest.mark.skipif(
    bool(REAL), reason="about the stand-in, and ROBOTWIN_ROOT names a real checkout: unset it"
)
on_real = pytest.mark.skipif(
    not REAL, reason="RoboTwin's own code: set ROBOTWIN_ROOT=CHECKOUT (docs/platforms.md)"
)


def run_fresh(script: str, **environment: str) -> str:
    """What a script prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def resident_kb() -> int:
    """Memory of this process, kB."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


@functools.cache
def can_render() -> bool:
    """Whether SAPIEN finds a Vulkan device here; asked in a process of its own, because it may crash."""
    done = subprocess.run([sys.executable, "-c", "import sapien; sapien.Scene()"], capture_output=True)
    return done.returncode == 0
