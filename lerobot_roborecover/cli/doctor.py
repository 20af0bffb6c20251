"""`roborecover doctor`."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass

from lerobot_roborecover.utils.options import option

HELP = "Check what evaluation and scores need on this machine, and say what to do about what is missing."


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """What to check."""

    platform: str = option("all", metavar="NAME")
    """What has to work, e.g. libero; with {default} (the default), a platform that is not installed is only a
    warning."""
    json: bool = False
    """Print the checks as one JSON object."""


OPTIONS = DoctorOptions


def run(options: DoctorOptions) -> int:
    """Runs the checks; 0 when none failed, 1 otherwise."""
    from lerobot_roborecover.doctor import examine, format_report, report_json

    if not options.json:
        print("checking (up to a minute) ...", file=sys.stderr)
    checks = examine(options.platform)
    print(json.dumps(report_json(checks), indent=2) if options.json else format_report(checks))
    return int(any(check.failed for check in checks))
