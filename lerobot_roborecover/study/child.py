"""Commands as processes of their own: no interpreter carries anything from one to the next."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import IO

from lerobot_roborecover.workers.parent import ends_with_this

DEFAULTS: Mapping[str, str] = {"MUJOCO_GL": "egl", "HF_HUB_OFFLINE": "1"}
"""Unless the caller's environment says otherwise."""
CANNOT_START = "cannot start "
"""What `startable` begins a line with that names a run and says why it cannot be begun."""


def run_module(module: str, argv: Sequence[str], kernels: Mapping[str, str], log: IO | None = None) -> int:
    """Runs `python -m MODULE ARGV`, ended with its parent whatever ends that.

    Args:
        module: of the project or of LeRobot.
        argv: its arguments.
        kernels: variables that decide how it rounds; they win over the environment.
        log: takes everything that it says; None leaves it on the terminal.

    Returns:
        Its exit status.
    """
    return subprocess.run(
        [sys.executable, "-m", module, *argv],
        stdin=subprocess.DEVNULL, stdout=log, stderr=None if log is None else subprocess.STDOUT,
        env={**DEFAULTS, **os.environ, **kernels}, preexec_fn=ends_with_this(),
    ).returncode  # fmt: skip
