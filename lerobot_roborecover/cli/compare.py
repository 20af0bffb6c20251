"""`roborecover compare`."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

from lerobot_roborecover.cli.report import add_log_arguments, analysis_options

HELP = (
    "Compare two policies from their trial logs: difference, interval, adjusted p, where it comes "
    "from, and a "
    "verdict in words. Refuses logs that cannot be compared."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_log_arguments(parser)
    parser.add_argument("--a", metavar="NAME", help="first policy, where the logs hold more than two")
    parser.add_argument("--b", metavar="NAME", help="second policy")
    parser.add_argument(
        "--sequential",
        action="store_true",
        help="the logs are still growing, and looked at more than once: p and interval hold at every look",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Prints the comparison."""
    from lerobot_roborecover.analysis.compare import compare, to_json, to_screen
    from lerobot_roborecover.analysis.logs import read_study

    options = replace(analysis_options(args), sequential=args.sequential)
    found = compare(read_study(args.logs, args.platform), args.a, args.b, options)
    print(json.dumps(to_json(found), indent=1) if args.json else to_screen(found))
    return 0
