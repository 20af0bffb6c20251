"""`roborecover leaderboard`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.cli.report import add_draws_arguments, analysis_options

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.leaderboard import Leaderboard

HELP = (
    "Make a leaderboard (a static page, JSON, a Space for the Hub) from all trial logs below a folder; offer "
    "one policy's results to its model on the Hub; compare with the Hub's board."
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
    space = parser.add_argument_group("a Space")
    add = space.add_argument
    add("--space", type=Path, metavar="DIR", help="also write a static Space: boards, scenarios, videos")
    add("--render", action="store_true", help="render recovery frames that the scenario sets do not hold")
    add(
        "--videos", action="append", default=[], metavar="NAME=DIR",
        help="a policy's videos or .rrd recordings for the Space; may be given again",
    )  # fmt: skip
    hub = parser.add_argument_group("results on the Hub")
    add = hub.add_argument
    add(
        "--hub",
        metavar="ORG/MODEL",
        help="offer one policy's results to this model's repository as a pull request (.eval_results/*.yaml)",
    )
    add("--policy", help="whose results to offer, where there are several")
    add("--dataset-id", metavar="ORG/NAME", help="the scenario set on the Hub, where the logs name a folder")
    add("--source", metavar="URL", help="where the trial log is published")
    add("--with-log", action="store_true", help="put the trial log into the pull request, as the source")
    add("--dry-run", action="store_true", help="show what would be offered, and offer nothing")
    add(
        "--hub-board",
        metavar="ORG/SET",
        help="read this scenario set's results on the Hub, and compare them with the local ones",
    )


def run(args: argparse.Namespace) -> int:
    """Writes the page; offers and compares where asked. 1 when some log could not be used."""
    from lerobot_roborecover.analysis.leaderboard import make_leaderboard
    from lerobot_roborecover.analysis.pages.leaderboard import board_table, write_leaderboard
    from lerobot_roborecover.analysis.tables import to_text

    found = make_leaderboard(args.folder, analysis_options(args), args.method)
    page, data = write_leaderboard(found, args.out, args.title)
    for board in found.boards:
        table = board_table(board)
        print(f"{table.title}\n{to_text(table)}\n")
    for name, reason in found.refused:
        print(f"not used: {name}: {reason}")
    print(f"page      {page}\ndata      {data}")
    if args.space:
        _write_space(args, found)
    if args.hub:
        _offer(args, found)
    if args.hub_board:
        from lerobot_roborecover.analysis.hub_board import comparison_table, read_board

        table = comparison_table(args.hub_board, read_board(args.hub_board), found)
        print(f"\n{table.title}\n{to_text(table)}")
    return int(bool(found.refused))


def _write_space(args: argparse.Namespace, found: Leaderboard) -> None:
    from lerobot_roborecover.analysis.named_path import split_named
    from lerobot_roborecover.analysis.pages.space import SpaceConfig, write_space

    media = [(name, Path(folder)) for name, folder in map(split_named, args.videos)]
    for remark in write_space(found, args.space, SpaceConfig(args.title, args.render, media)):
        print(f"note: {remark}", file=sys.stderr)
    print(f"space     {args.space}: hf upload ORG/NAME {args.space} --repo-type space")


def _offer(args: argparse.Namespace, found: Leaderboard) -> None:
    from lerobot_roborecover.analysis import hub_results
    from lerobot_roborecover.errors import OptionError

    if args.source and args.with_log:
        raise OptionError("--source and --with-log: a result has one source. Leave one of them out")
    board, entry = hub_results.find_entry(found, args.policy)
    logs = hub_results.log_files(args.folder, entry) if args.with_log else {}
    source = next((hub_results.file_address(args.hub, path) for path in logs), args.source)
    path = hub_results.file_name(board)
    text = hub_results.results_yaml(board, entry, args.dataset_id, source)
    print(f"\n{path} in {args.hub}:\n{text}")
    if source is None:
        print(
            "no source: --with-log puts the trial log beside the result, --source=URL names a published one"
        )
    if args.dry_run:
        print("dry run: nothing was offered")
        return
    print(f"offered   {hub_results.offer_results(args.hub, {path: text.encode(), **logs})}")
