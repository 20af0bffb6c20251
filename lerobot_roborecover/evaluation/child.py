"""Commands as processes of their own: no interpreter carries anything from one to the next."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

from lerobot_roborecover.workers.parent import ends_with_this, stop_children

DEFAULTS: Mapping[str, str] = {"MUJOCO_GL": "egl", "HF_HUB_OFFLINE": "1"}
"""Unless the caller's environment says otherwise."""
NESTED = "ROBORECOVER_NESTED"
"""Variable of a command that another command runs: the outer one says what comes next."""
_running: set[subprocess.Popen] = set()
_POLL_S = 0.5
CANNOT_START = "cannot start "
"""What `startable` begins a line with that names a run and says why it cannot be begun."""


def this_module(module: str) -> list[str]:
    """Beginning of a command that runs a module of the project or of LeRobot."""
    return [sys.executable, "-m", module]


def run_program(
    command: Sequence[str],
    variables: Mapping[str, str],
    output: Path | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Runs a command that ends with its parent, in good order if possible.

    Args:
        command: program and arguments.
        variables: win over the environment, such as those that decide how a policy rounds.
        output: file that takes everything that it says, at its end; None leaves it on the terminal.
        watch: called twice a second while it runs.

    Returns:
        Its exit status.
    """
    with nullcontext(None) if output is None else output.open("ab") as stream:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL, stdout=stream, stderr=None if stream is None else subprocess.STDOUT,
            env={**DEFAULTS, **os.environ, **variables, NESTED: "1"}, preexec_fn=ends_with_this(),
        )  # fmt: skip
        _running.add(process)
        try:
            while True:
                try:
                    return process.wait(None if watch is None else _POLL_S)
                except subprocess.TimeoutExpired:
                    if watch is not None:
                        watch()
        except BaseException:
            stop_children([process])
            raise
        finally:
            _running.discard(process)


def stop_running() -> None:
    """Stops the children that other threads wait for."""
    stop_children(list(_running))
