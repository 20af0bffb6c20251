"""What this process may use of its machine: cores and memory, under the limits of a container or scheduler.

`docker run --cpus=2 --memory=4g`, Kubernetes and Slurm limit a control group (cgroup), not what the machine
reports. Version 1 and 2 of the kernel's interface are read, and every group that this one is in, since the
tightest limit holds.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

SLOT_GB = 1.5
"""Memory reckoned for a simulator: a worker that has several tasks compiled, and its first pictures."""
_ROOT = Path("/")


def default_slots(policy_device: str, cores: int, memory_gb: float) -> int:
    """Returns the number of simulators to run at once, limited by memory and at least one.

    With a policy on a GPU: two simulators per core, so that one steps during the inference for the other.
    With a policy on the CPU, which needs the cores itself: one simulator per core.

    Args:
        policy_device: torch's name of the policy's device.
        cores: cores that simulators may use.
        memory_gb: memory that simulators may take.
    """
    wanted = cores if policy_device == "cpu" else 2 * cores
    return max(1, min(wanted, int(min(memory_gb, 1e6) / SLOT_GB)))


def usable_cores(root: Path = _ROOT) -> int:
    """Returns how many cores this process may use; a part of one counts as one.

    Args:
        root: of the file system that is asked.
    """
    affinity = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(affinity, math.ceil(min(cpu_quota(root), affinity))))


def available_gb(root: Path = _ROOT) -> float:
    """Returns the memory that is free or can be freed, in GiB; infinite where the system does not say.

    Args:
        root: of the file system that is asked.
    """
    return min(_machine_bytes(root), _group_bytes(root)) / 2**30


def cpu_quota(root: Path = _ROOT) -> float:
    """Returns the cores' worth of time that control groups grant, such as 1.5; infinite without a limit."""
    found = [math.inf]
    for folder in _groups(root, "cpu"):
        quota, period = _numbers(folder / "cpu.max", 2)
        found.append(quota / period)
        (quota,), (period,) = _numbers(folder / "cpu.cfs_quota_us"), _numbers(folder / "cpu.cfs_period_us")
        found.append(quota / period if quota > 0 else math.inf)  # -1 is no limit
    return min(value for value in found if not math.isnan(value))


def _machine_bytes(root: Path) -> float:
    for line in _text(root / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 2**10
    return math.inf


def _group_bytes(root: Path) -> float:
    """The least that a control group has left; the cache of files that it could drop counts as left."""
    found = [math.inf]
    for folder in _groups(root, "memory"):
        for limit, used, cache in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            (most,), (now,) = _numbers(folder / limit), _numbers(folder / used)
            if math.isinf(most) or math.isinf(now):
                continue
            words = [line.split() for line in _text(folder / "memory.stat").splitlines()]
            dropped = sum(int(pair[1]) for pair in words if pair[0] == cache)
            found.append(max(most - max(now - dropped, 0), 0))
    return min(found)


def _groups(root: Path, controller: str) -> Iterator[Path]:
    """Folders of this process's control groups, inner ones first, as far as they are mounted.

    A container may see its own group as the root, or by its name on the host, of which nothing is mounted.
    """
    mount = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, name = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        # Version 1 has a folder for each controller, or for several that are mounted together.
        base = mount / controllers if controllers else mount
        base = base if base.is_dir() else mount / controller
        path = PurePosixPath(name.lstrip("/"))
        yield from (base / part for part in (path, *path.parents) if (base / part).is_dir())


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError:
        return ""


def _numbers(path: Path, count: int = 1) -> list[float]:
    """A file's numbers; `max`, and what is not there, are infinite."""
    words = _text(path).split()[:count]
    found = [float(word) if word.lstrip("-").isdigit() else math.inf for word in words]
    return found + [math.inf] * (count - len(found))
