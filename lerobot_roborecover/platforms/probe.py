"""Questions that need a heavy or a risky import, asked in processes of their own.

An OpenGL driver may end the process that loads it, and LeRobot takes 15 s to import: one process imports
it once and answers everything that needs it or torch.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

_MARK = "roborecover-probe:"


def answer(answers: Mapping[str, Any]) -> None:
    """Prints a probe's answers; called in the probe's process."""
    print(_MARK + json.dumps(answers), flush=True)


def last_answer(output: str) -> dict[str, Any] | None:
    """What a probe's process answered, whatever else it printed; None where it did not."""
    for line in reversed(output.splitlines()):
        if line.startswith(_MARK):
            return json.loads(line.removeprefix(_MARK))
    return None


def run_probe(
    module: str, *, timeout_s: float, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Runs a probe in a fresh interpreter.

    Args:
        module: that calls `answer` when run; of this package.
        timeout_s: longest it may take, seconds.
        environment: variables to set for it, beside this process's own.

    Returns:
        Its answers; or `{"error": why}` when the process gave none.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-m", f"lerobot_roborecover.{module}"],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **(environment or {})},
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {timeout_s:g} s"}
    found = last_answer(done.stdout)
    if found is not None:
        return found
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return {"error": lines[-1][:400] if lines else f"exit status {done.returncode}"}
