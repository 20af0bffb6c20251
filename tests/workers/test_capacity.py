"""What a process may use: the machine's, or less where its control groups say so."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from lerobot_roborecover.workers.capacity import available_gb, cpu_quota, usable_cores

GIB = 2**30
LOCAL = len(os.sched_getaffinity(0))


def machine(root: Path, files: dict[str, object]) -> Path:
    for name, text in {"proc/meminfo": "MemTotal: 1 kB\nMemAvailable: 8388608 kB\n", **files}.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(f"{text}\n")
    return root


def test_without_control_groups_the_machine_counts(tmp_path):
    assert (usable_cores(tmp_path), available_gb(tmp_path)) == (LOCAL, math.inf)
    root = machine(tmp_path, {"proc/self/cgroup": "0::/", "sys/fs/cgroup/cgroup.procs": ""})
    assert (usable_cores(root), available_gb(root)) == (LOCAL, 8.0)


@pytest.mark.parametrize(
    "files",
    [
        # Docker with version 2: the container sees its group as the root.
        {
            "proc/self/cgroup": "0::/",
            "sys/fs/cgroup/cpu.max": "150000 100000",
            "sys/fs/cgroup/memory.max": 4 * GIB,
            "sys/fs/cgroup/memory.current": 2 * GIB,
            "sys/fs/cgroup/memory.stat": f"anon 5\ninactive_file {GIB}",
        },
        # Slurm or systemd: limits at the group and, tighter or not at all, above it.
        {
            "proc/self/cgroup": "0::/slurm/job/step",
            "sys/fs/cgroup/slurm/job/step/cpu.max": "max 100000",
            "sys/fs/cgroup/slurm/job/cpu.max": "75000 50000",
            "sys/fs/cgroup/slurm/cpu.max": "900000 100000",
            "sys/fs/cgroup/slurm/job/step/memory.max": "max",
            "sys/fs/cgroup/slurm/job/memory.max": 4 * GIB,
            "sys/fs/cgroup/slurm/job/memory.current": GIB,
        },
        # Version 1, named as on the host, mounted as the root.
        {
            "proc/self/cgroup": "9:memory:/docker/abc\n4:cpu,cpuacct:/docker/abc\n0::/docker/abc",
            "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": 150000,
            "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": 100000,
            "sys/fs/cgroup/memory/memory.limit_in_bytes": 4 * GIB,
            "sys/fs/cgroup/memory/memory.usage_in_bytes": 3 * GIB,
            "sys/fs/cgroup/memory/memory.stat": f"inactive_file 1\ntotal_inactive_file {2 * GIB}",
        },
    ],
)
def test_the_tightest_limit_holds(tmp_path, files):
    root = machine(tmp_path, files)
    assert cpu_quota(root) == 1.5
    assert usable_cores(root) == min(2, LOCAL), "a part of a core is used, too"
    assert available_gb(root) == 3.0


def test_version_1_without_limits(tmp_path):
    root = machine(
        tmp_path,
        {
            "proc/self/cgroup": "2:memory:/\n1:cpu:/",
            "sys/fs/cgroup/cpu/cpu.cfs_quota_us": -1,
            "sys/fs/cgroup/cpu/cpu.cfs_period_us": 100000,
            "sys/fs/cgroup/memory/memory.limit_in_bytes": 9223372036854771712,
            "sys/fs/cgroup/memory/memory.usage_in_bytes": GIB,
        },
    )
    assert cpu_quota(root) == math.inf
    assert (usable_cores(root), available_gb(root)) == (LOCAL, 8.0)


def test_here():
    assert 1 <= usable_cores() <= LOCAL
    assert available_gb() > 0


@pytest.mark.lerobot
def test_torch_has_no_more_threads_than_a_container_grants(monkeypatch):
    import torch

    from lerobot_roborecover.policies import determinism

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(6)
        monkeypatch.setattr(determinism, "usable_cores", lambda: 3)
        determinism.fit_threads("cuda")
        assert torch.get_num_threads() == 6
        determinism.fit_threads("cpu")
        assert torch.get_num_threads() == 3
        monkeypatch.setattr(determinism, "usable_cores", lambda: 64)
        determinism.fit_threads(torch.device("cpu"))
        assert torch.get_num_threads() == 3, "what the user set is left alone"
    finally:
        torch.set_num_threads(before)
