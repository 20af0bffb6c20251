"""Who runs, and whether it has ended, as Linux tells it."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

PATIENCE_S = 1800.0
"""How long a test waits for what has to come. It only ends what hangs: nothing is expected within a time,
since other work on the machine makes anything slow."""


def children(process: subprocess.Popen) -> set[str]:
    """Process ids of what a process has started; empty where it is gone."""
    try:
        return set(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
    except OSError:
        return set()


def alive_after(pids: set[str], seconds: float = PATIENCE_S) -> set[str]:
    """Those of some processes that still run once they have had so long to end."""
    deadline = time.monotonic() + seconds
    while (alive := {pid for pid in pids if _runs(pid)}) and time.monotonic() < deadline:
        time.sleep(0.05)
    return alive


def _runs(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
