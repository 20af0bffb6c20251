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
    parser.add_argument(
        "--scenarios",
        help="with --sequential: the set that the runs were to evaluate (shipped name, folder, Hub id) where "
        "the logs do not name all of it yet",
    )
    parser.add_argument("--revision", help="commit, tag or branch of that set on the Hub")
    parser.add_argument("--select", default="", help="the runs' --env.select")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Prints the comparison."""
    from lerobot_roborecover.analysis.compare import compare, to_json, to_screen
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.sequential_plan import planned_units
    from lerobot_roborecover.analysis.stats.estimators import RowsError

    if args.scenarios and not args.sequential:
        raise RowsError(
            f"--scenarios {args.scenarios} says what --sequential plans for; give both or neither"
        )
    study, planned = read_study(args.logs, args.platform), None
    if args.scenarios:
        planned = planned_units(study, args.scenarios, args.revision, args.select)
    options = replace(analysis_options(args), sequential=args.sequential, planned=planned)
    found = compare(study, args.a, args.b, options)
    print(json.dumps(to_json(found), indent=1) if args.json else to_screen(found))
    return 0
