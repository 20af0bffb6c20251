"""Checks of the machine: OpenGL, GPU, cores, disk."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_roborecover.platforms.findings import Check, Status
from lerobot_roborecover.platforms.probe import run_probe
from lerobot_roborecover.workers.capacity import usable_cores

_RENDER_TIMEOUT_S = 60.0
_LOW_DISK_GB = 5.0


def check_opengl() -> Check:
    """A test picture with the configured OpenGL; when it fails, whether another way works."""
    name = "OpenGL"
    linux = sys.platform.startswith("linux")
    chosen = os.environ.get("MUJOCO_GL") or ("egl" if linux else "")
    shown = f"MUJOCO_GL={chosen or 'default'}"
    if chosen.lower() in ("disable", "disabled", "off", "false", "0"):
        return Check(
            name, Status.FAILURE, f"{shown} switches rendering off", "unset MUJOCO_GL, or set it to egl"
        )
    found = _render(chosen)
    if "error" not in found and found["correct"]:
        return Check(
            name, Status.OK, f"{shown} renders a test picture on {found['renderer'] or 'an unnamed driver'}"
        )
    why = found.get("error", f"the test picture is wrong on {found.get('renderer') or 'an unnamed driver'}")
    for other in ("egl", "osmesa") if linux else ():
        if other != chosen and _render(other).get("correct"):
            return Check(
                name, Status.FAILURE, f"{shown}: {why}", f"{other} works here: export MUJOCO_GL={other}"
            )
    remedy = (
        "Debian: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libosmesa6; on a GPU machine also the "
        "driver's EGL library. Without OpenGL only Meta-World with --env.obs_type=state runs"
    )
    return Check(name, Status.FAILURE, f"{shown}: {why}", remedy)


def _render(backend: str) -> dict[str, Any]:
    environment = {"MUJOCO_GL": backend} if backend else {}
    return run_probe("doctor.probe_render", timeout_s=_RENDER_TIMEOUT_S, environment=environment)


def check_gpu(probe: Mapping[str, Any]) -> Check:
    """GPUs that torch can use; a warning without, since small policies and every simulator here run on CPU.

    Args:
        probe: answers of `probe_lerobot`.
    """
    name = "GPU"
    cuda = probe.get("cuda", {})
    if "error" in probe or "error" in cuda:
        return Check(name, Status.WARNING, f"torch gave no answer: {cuda.get('error') or probe.get('error')}")
    if cuda.get("devices"):
        return Check(name, Status.OK, f"torch {cuda['torch']} sees {', '.join(cuda['devices'])}")
    driver = _driver()
    if driver:
        detail = f"torch {cuda.get('torch')} sees none, but the driver lists {driver}"
        remedy = "install a torch build for this driver's CUDA version (see nvidia-smi)"
        return Check(name, Status.WARNING, detail, remedy)
    remedy = "large policies need one; the demo and all simulators run without"
    return Check(name, Status.WARNING, f"torch {cuda.get('torch')} sees none", remedy)


def _driver() -> str:
    """GPUs that the NVIDIA driver lists; empty where there is no driver."""
    if shutil.which("nvidia-smi") is None:
        return ""
    command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return ", ".join(done.stdout.split("\n")).strip(", ") if done.returncode == 0 else ""


def check_cores() -> Check:
    """Processor cores this process may use."""
    cores, there = usable_cores(), os.cpu_count() or 1
    if cores > 1:
        of = f" of {there}: the others are not for this process (affinity, or a container's quota)"
        return Check("Cores", Status.OK, f"{cores}{of if cores < there else ''}")
    return Check("Cores", Status.WARNING, "1", "simulators run one per core: use --eval.batch_size=1")


def check_disk(folder: Path | None = None) -> Check:
    """Free space where results go.

    Args:
        folder: by default the working directory.
    """
    folder = folder or Path.cwd()
    free_gb = shutil.disk_usage(folder).free / 1e9
    detail = f"{free_gb:.0f} GB free in {folder}"
    if free_gb >= _LOW_DISK_GB:
        return Check("Disk", Status.OK, detail)
    return Check(
        "Disk",
        Status.WARNING,
        detail,
        "checkpoints take 1 to 10 GB each: free some, or set HF_HOME elsewhere",
    )
