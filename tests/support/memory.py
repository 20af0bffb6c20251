"""Measures how much memory an expression takes, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.support.processes import PATIENCE_S

_CHILD = """
import json, resource, sys
{setup}
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    {expression}
    said = ""
except Exception as err:
    said = f"{{type(err).__name__}}: {{err}}"
print(json.dumps([said, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024]))
"""


def peak_bytes(setup: str, expression: str) -> tuple[str, int]:
    """Runs an expression in a child process.

    Args:
        setup: statements that are not measured, such as imports.
        expression: what is measured.

    Returns:
        What it raised, in words, and by how much the process's largest size grew.
    """
    code = _CHILD.format(setup=setup, expression=expression)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    said, grown = json.loads(done.stdout.splitlines()[-1])
    return said, grown
