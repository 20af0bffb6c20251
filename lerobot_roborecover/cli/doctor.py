"""`roborecover doctor`."""

from __future__ import annotations

import argparse
import json
import sys

HELP = "Check what evaluation and scores need on this machine, and say what to do about what is missing."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "--platform",
        metavar="NAME",
        default="all",
        help="what has to work, e.g. libero; with all (the default), a platform that is not "
        "installed is only a warning",
    )
    parser.add_argument("--json", action="store_true", help="print the checks as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Runs the checks; 0 when none failed, 1 otherwise."""
    from lerobot_roborecover.doctor import examine, format_report, report_json

    if not args.json:
        print("checking (up to a minute) ...", file=sys.stderr)
    checks = examine(args.platform)
    print(json.dumps(report_json(checks), indent=2) if args.json else format_report(checks))
    return int(any(check.failed for check in checks))
