"""Checks of Python, packages and their versions, and of LeRobot finding this plugin."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from lerobot_roborecover.platforms import versions
from lerobot_roborecover.platforms.findings import Check, Status
from lerobot_roborecover.utils.lerobot_versions import TESTED, version_problem
from lerobot_roborecover.utils.text import DISTRIBUTION

MINIMUM_PYTHON = (3, 12)


def check_python() -> Check:
    found = f"{platform.python_version()} ({sys.executable})"
    if sys.version_info[:2] >= MINIMUM_PYTHON:
        return Check("Python", Status.OK, found)
    return Check("Python", Status.FAILURE, found, "use Python 3.12: uv venv --python 3.12")


def check_versions(platform_name: str, required: bool) -> list[Check]:
    """One check for each package on which the platform's scores depend.

    Args:
        platform_name: e.g. `libero`.
        required: a package that is not installed is a failure rather than a warning.
    """
    checks = []
    for distribution, accepted in versions.required(platform_name).items():
        name = f"{platform_name} scores: {distribution}"
        found = versions.installed(distribution)
        wanted = " or ".join(accepted)
        if found is None:
            status = Status.FAILURE if required else Status.WARNING
            remedy = versions.install_command(platform_name)
            checks.append(Check(name, status, f"not installed; {wanted} is required", remedy))
        elif distribution in versions.STAMPS and not version_problem(found):
            detail = f"{found}, which is written to every row; tests were run with {' and '.join(TESTED)}"
            checks.append(Check(name, Status.OK, detail))
        elif found in accepted:
            checks.append(Check(name, Status.OK, found))
        else:
            detail = f"{found}; comparable scores require {wanted}"
            checks.append(Check(name, Status.FAILURE, detail, f"pip install '{distribution}=={accepted[0]}'"))
    return checks


def check_plugin(probe: Mapping[str, Any]) -> Check:
    """Whether LeRobot finds the plugin: it imports a module named exactly like each installed distribution.

    Args:
        probe: answers of `probe_lerobot`.
    """
    name = "LeRobot plugin"
    names = {d.metadata["Name"] for d in metadata.distributions() if d.metadata["Name"]}
    if DISTRIBUTION not in names:
        odd = sorted(n for n in names if n.lower().replace("-", "_") == DISTRIBUTION)
        detail = f"installed as {odd[0]!r}, a name that LeRobot does not import" if odd else "not installed"
        return Check(
            name, Status.FAILURE, f"distribution {DISTRIBUTION} is {detail}", "pip install -e . in the clone"
        )
    types = probe.get("env_types", probe)
    if isinstance(types, dict) or not types:
        why = types.get("error", "no answer") if isinstance(types, dict) else "it registers no env type"
        remedy = f"python -c 'import {DISTRIBUTION}' shows the error; then install what it names"
        return Check(name, Status.FAILURE, f"cannot be imported: {why}", remedy)
    if probe.get("discovered") is not True:
        remedy = f"pass --env.discover_packages_path=lerobot_roborecover, or install {DISTRIBUTION} again"
        return Check(name, Status.FAILURE, "LeRobot's discovery does not import it", remedy)
    return Check(name, Status.OK, f"registers {', '.join(types)}")


def check_opencv(probe: Mapping[str, Any]) -> Check:
    """OpenCV: two distributions write the same folder `cv2`."""
    name = "OpenCV"
    both = [d for d in ("opencv-python", "opencv-python-headless") if versions.installed(d)]
    described = ", ".join(f"{d} {versions.installed(d)}" for d in both) or "not installed"
    headless = versions.installed("opencv-python-headless") or ""
    remedy = (
        "pip uninstall -y opencv-python opencv-python-headless && "
        f"pip install opencv-python-headless{'==' + headless if headless else ''}"
    )
    answer = probe.get("cv2", probe)
    if isinstance(answer, dict):
        return Check(
            name, Status.FAILURE, f"{described}; cv2 cannot be imported: {answer.get('error')}", remedy
        )
    if len(both) > 1:
        detail = f"{described}: both write cv2/, the last one installed wins (now {answer})"
        return Check(name, Status.WARNING, detail, remedy)
    return Check(name, Status.OK, described)


def check_ffmpeg(probe: Mapping[str, Any]) -> Check:
    """FFmpeg's libraries, through torchcodec, which decodes LeRobot's videos."""
    name = "FFmpeg libraries"
    answer = probe.get("torchcodec", probe)
    if not isinstance(answer, dict):
        return Check(name, Status.OK, f"torchcodec {answer} finds them")
    detail = f"torchcodec cannot be used ({answer.get('error')}); PyAV decodes videos, nothing streams"
    return Check(name, Status.WARNING, detail, "install FFmpeg 4 to 8 (Debian: apt-get install ffmpeg)")
