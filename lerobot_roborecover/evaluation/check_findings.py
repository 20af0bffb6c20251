"""What `roborecover check policy` found, as a table and as JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_roborecover.platforms.findings import Status

SCHEMA = 1
_WIDTH = 110


@dataclass(frozen=True)
class Finding:
    """One check of a policy."""

    name: str
    """What was looked at."""
    status: Status
    value: str
    """What was found."""
    expected: str = ""
    """What would have been right; empty where there is no such thing."""
    remedy: str = ""
    """What to do about it; empty when all is well."""


def ok(name: str, value: str, expected: str = "") -> Finding:
    return Finding(name, Status.OK, value, expected)


def warning(name: str, value: str, expected: str, remedy: str) -> Finding:
    """Something that costs points often enough to be looked at before a long run."""
    return Finding(name, Status.WARNING, value, expected, remedy)


def failure(name: str, value: str, expected: str, remedy: str) -> Finding:
    """Something that makes a run worthless."""
    return Finding(name, Status.FAILURE, value, expected, remedy)


def format_findings(findings: Sequence[Finding]) -> str:
    """A line a check, then what was expected and the remedy where it is not well, and a count."""
    lines = []
    for f in findings:
        lines += _wrapped(f"{f.status.value:<8} {f.name}: {f.value}", "", " " * 12)
        if f.status is not Status.OK:
            if f.expected:
                lines += _wrapped(f"expected: {f.expected}", " " * 9, " " * 12)
            lines += _wrapped(f.remedy, " " * 9 + "-> ", " " * 12)
    counts = {status: sum(f.status is status for f in findings) for status in Status}
    lines.append(
        f"\n{len(findings)} checks: {counts[Status.OK]} ok, {counts[Status.WARNING]} warnings, "
        f"{counts[Status.FAILURE]} failures"
    )
    return "\n".join(lines)


def findings_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """The findings as plain data."""
    return {
        "schema": SCHEMA,
        "ok": all(f.status is not Status.FAILURE for f in findings),
        "checks": [
            {
                "name": f.name, "status": f.status.value, "value": f.value, "expected": f.expected,
                "remedy": f.remedy,
            }
            for f in findings
        ],
    }  # fmt: skip


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
