"""`roborecover merge`: one trial log from those of shards."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = "join the trial logs of shards; refuses logs of different protocols"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `roborecover merge`."""
    parser.add_argument("logs", nargs="+", type=Path, help="trial logs")
    parser.add_argument("--out", required=True, type=Path, help="the merged log")
    parser.add_argument("--force", action="store_true", help="replace a file that exists at --out")
    parser.add_argument(
        "--allow-unequal-trials", action="store_true", help="accept scenarios with fewer trials than others"
    )
    renamed(parser, "--allow-unequal-trials", "--unequal")


def run(args: argparse.Namespace) -> int:
    """Merges and says what came together."""
    from lerobot_roborecover.logs.merge import merge
    from lerobot_roborecover.utils.text import pluralize

    merged = merge(args.logs, args.out, unequal=args.allow_unequal_trials, force=args.force)
    scenarios = len({r.scenario_id for r in merged.rows})
    for remark in merged.remarks:
        print(f"note: {remark}", file=sys.stderr)
    found = f"{pluralize(len(merged.rows), 'trial')} of {pluralize(scenarios, 'scenario')}"
    print(f"{found} from {pluralize(len(args.logs), 'log')} in {args.out}")
    return 0
