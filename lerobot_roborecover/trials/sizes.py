"""How many simulators a machine runs at once where nobody says."""

from __future__ import annotations

import os
from pathlib import Path

SLOT_GB = 1.5
"""Memory reckoned for a simulator beyond one per core: a LIBERO worker that has two tasks compiled, and its
first pictures."""


def usable_cores() -> int:
    """Cores this process may use: under Slurm, say, fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_gb(meminfo: Path = Path("/proc/meminfo")) -> float:
    """Memory that is free or can be freed, in GB; infinite where the system does not say."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return float("inf")
    sizes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return sizes[0] / 2**20 if sizes else float("inf")


def default_slots(policy_device: str, cores: int, memory_gb: float) -> int:
    """Two simulators a core under a policy on a GPU, so that one steps while the other is inferred for; one a
    core under a policy on the CPU, which needs the cores itself.

    Args:
        policy_device: torch's name of it.
        cores: that simulators may use.
        memory_gb: that they may take; it limits the second slot of a core.
    """
    if policy_device == "cpu":
        return cores
    return max(cores, min(2 * cores, int(min(memory_gb, 1e6) / SLOT_GB)))
