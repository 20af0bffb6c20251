"""`roborecover dataset repair`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Rebuild a dataset's meta/roborecover after LeRobot's tools (merge, delete, split) have worked on it."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder that a tool has made")
    add(
        "--from", dest="sources", nargs="+", required=True, metavar="SOURCE", help="datasets it was made from"
    )
    add("--dry-run", action="store_true", help="say what would be done, and change nothing")


def run(args: argparse.Namespace) -> int:
    """Repairs, and says what it did."""
    from lerobot_roborecover.curation.repair import repair_dataset

    print("\n".join(repair_dataset(args.dataset, args.sources, dry_run=args.dry_run).lines))
    return 0
