"""`roborecover leaderboard`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.cli.report import add_draws_arguments, analysis_options

HELP = (
    "Make a leaderboard (a static page and JSON) from all trial logs below a folder; or push one "
    "policy's results "
    "to its model repository on the Hub."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("folder", type=Path, help="folder of trial logs (*.jsonl), at any depth")
    add("--out", type=Path, default=Path("outputs/leaderboard"), help="folder of the page (%(default)s)")
    add("--title", default="Recovery leaderboard", help="heading of the page (%(default)s)")
    add_draws_arguments(parser)
    add(
        "--method",
        action="append",
        default=[],
        metavar="NAME=LOG,LOG",
        help="logs below the folder (or folders of them) that are the runs of one method; may be given again",
    )
    add(
        "--push-to",
        metavar="ORG/MODEL",
        help="push results to this model on the Hub as evaluation-results metadata",
    )
    add("--policy", help="whose results to push, where there are several")
    add("--dataset-id", metavar="ORG/NAME", help="the scenario set on the Hub, where the logs name a folder")
    add("--dry-run", action="store_true", help="show what would be pushed, and push nothing")


def run(args: argparse.Namespace) -> int:
    """Writes the page; pushes where asked. 1 when some log could not be used."""
    from lerobot_roborecover.analysis.hub_results import file_name, find_entry, push_results, results_yaml
    from lerobot_roborecover.analysis.leaderboard import make_leaderboard
    from lerobot_roborecover.analysis.leaderboard_page import board_table, write_leaderboard
    from lerobot_roborecover.analysis.tables import to_text

    found = make_leaderboard(args.folder, analysis_options(args), args.method)
    page, data = write_leaderboard(found, args.out, args.title)
    for board in found.boards:
        table = board_table(board)
        print(f"{table.title}\n{to_text(table)}\n")
    for name, reason in found.refused:
        print(f"not used: {name}: {reason}")
    print(f"page      {page}\ndata      {data}")
    if args.push_to:
        board, entry = find_entry(found, args.policy)
        text, path = results_yaml(board, entry, args.dataset_id), file_name(board)
        print(f"\n{path} in {args.push_to}:\n{text}")
        if args.dry_run:
            print("dry run: nothing was pushed")
        else:
            print(f"commit    {push_results(args.push_to, path, text)}")
    return int(bool(found.refused))
