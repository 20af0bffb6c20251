"""The doctor's findings as text and as JSON."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from lerobot_roborecover.platforms.findings import Check, Status

REPORT_SCHEMA = 1
_WIDTH = 110


def format_report(checks: Sequence[Check]) -> str:
    """The report as text: a line a check, its remedy below, and a count at the end."""
    return "\n".join([*(line for check in checks for line in check_lines(check)), f"\n{count_line(checks)}"])


def check_lines(check: Check) -> list[str]:
    lines = [f"{check.status.value:<8} {check.name}: {check.detail}"]
    if check.remedy:
        lines += textwrap.wrap(
            check.remedy,
            _WIDTH,
            initial_indent=" " * 9 + "-> ",
            subsequent_indent=" " * 12,
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines


def count_line(checks: Sequence[Check]) -> str:
    counts = {status: sum(check.status is status for check in checks) for status in Status}
    return (
        f"{len(checks)} checks: {counts[Status.OK]} ok, {counts[Status.WARNING]} warnings, "
        f"{counts[Status.FAILURE]} failures"
    )


def report_json(checks: Sequence[Check]) -> dict[str, Any]:
    """The report as plain data: `schema`, `ok` and the list `checks`."""
    return {
        "schema": REPORT_SCHEMA,
        "ok": not any(check.failed for check in checks),
        "checks": [
            {"name": c.name, "status": c.status.value, "detail": c.detail, "remedy": c.remedy} for c in checks
        ],
    }
