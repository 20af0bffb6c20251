"""What a check of a machine, a simulator or a policy found: the record, and its text and JSON, for
`roborecover doctor`, `check platform` and `check policy`."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

REPORT_SCHEMA = 1
_WIDTH = 110


class Status(StrEnum):
    """Outcome of a check; only a failure changes the exit status."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True)
class Check:
    """One line of a report."""

    name: str
    """What was looked at."""
    status: Status
    detail: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty when all is well."""
    expected: str = ""
    """What would have been right; empty where there is no such thing."""

    @property
    def failed(self) -> bool:
        """Whether this alone makes the report a failure."""
        return self.status is Status.FAILURE


def ok(name: str, detail: str, expected: str = "") -> Check:
    return Check(name, Status.OK, detail, expected=expected)


def warning(name: str, detail: str, expected: str, remedy: str) -> Check:
    """Something that costs points often enough to be looked at before a long run."""
    return Check(name, Status.WARNING, detail, remedy, expected)


def failure(name: str, detail: str, expected: str, remedy: str) -> Check:
    """Something that makes a run worthless."""
    return Check(name, Status.FAILURE, detail, remedy, expected)


def format_report(checks: Sequence[Check]) -> str:
    """The report as text: each check (`check_lines`), and a count at the end."""
    return "\n".join([*(line for check in checks for line in check_lines(check)), f"\n{count_line(checks)}"])


def check_lines(check: Check) -> list[str]:
    """One check as text: what was found, then what was expected, unless all is well, and the remedy."""
    lines = _wrapped(f"{check.status.value:<8} {check.name}: {check.detail}", "")
    if check.expected and check.status is not Status.OK:
        lines += _wrapped(f"expected: {check.expected}", " " * 9)
    return lines + _wrapped(check.remedy, " " * 9 + "-> ")


def count_line(checks: Sequence[Check]) -> str:
    counts = {status: sum(check.status is status for check in checks) for status in Status}
    return (
        f"{len(checks)} checks: {counts[Status.OK]} ok, {counts[Status.WARNING]} warnings, "
        f"{counts[Status.FAILURE]} failures"
    )


def report_json(checks: Sequence[Check]) -> dict[str, Any]:
    """The report as plain data: `schema`, `ok` and the list `checks`. `value` is an earlier name of
    `detail`."""
    return {
        "schema": REPORT_SCHEMA,
        "ok": not any(check.failed for check in checks),
        "checks": [
            {
                "name": c.name, "status": c.status.value, "detail": c.detail, "value": c.detail,
                "expected": c.expected, "remedy": c.remedy,
            }
            for c in checks
        ],
    }  # fmt: skip


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        text, _WIDTH, initial_indent=indent, subsequent_indent=" " * 12, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip
