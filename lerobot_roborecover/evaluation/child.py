"""Commands as processes of their own: no interpreter carries anything from one to the next."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import IO

from lerobot_roborecover.workers.parent import ends_with_this, stop_children

DEFAULTS: Mapping[str, str] = {"MUJOCO_GL": "egl", "HF_HUB_OFFLINE": "1"}
"""Unless the caller's environment says otherwise."""
_running: set[subprocess.Popen] = set()
CANNOT_START = "cannot start "
"""What `startable` begins a line with that names a run and says why it cannot be begun."""


def run_module(module: str, argv: Sequence[str], kernels: Mapping[str, str], log: IO | None = None) -> int:
    """Runs `python -m MODULE ARGV`, which ends with its parent, in good order if possible.

    Args:
        module: of the project or of LeRobot.
        argv: its arguments.
        kernels: variables that decide how it rounds; they win over the environment.
        log: takes everything that it says; None leaves it on the terminal.

    Returns:
        Its exit status.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", module, *argv],
        stdin=subprocess.DEVNULL, stdout=log, stderr=None if log is None else subprocess.STDOUT,
        env={**DEFAULTS, **os.environ, **kernels}, preexec_fn=ends_with_this(),
    )  # fmt: skip
    _running.add(process)
    try:
        return process.wait()
    except BaseException:
        stop_children([process])
        raise
    finally:
        _running.discard(process)


def stop_running() -> None:
    """Stops the children that other threads wait for."""
    stop_children(list(_running))
