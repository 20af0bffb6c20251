"""`roborecover curate annotate`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Mark recovery points, stages and types in a local web page, each annotator alone and blind."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder of a candidate dataset")
    add(
        "--annotator", dest="annotators", action="append", default=[], metavar="NAME",
        help="who annotates; repeat it for several at once, each with an address of their own",
    )  # fmt: skip
    add(
        "--automatic", action="store_true",
        help="no people: three programs apply written rules to the recorded steps; their labels are "
        "marked as automatic wherever they go",
    )  # fmt: skip
    add("--port", type=int, default=8731, help="on this machine alone; 0 takes a free one (%(default)s)")
    add("--votes", type=Path, metavar="FOLDER", help="of all votes (DATASET/meta/roborecover/votes)")
    add("--seed", type=int, default=0, help="of the order in which each annotator sees the episodes")
    add(
        "--only",
        type=Path,
        metavar="LIST",
        help="a further round over what `roborecover curate agree --discuss` lists",
    )
    add(
        "--no-examples", action="store_true",
        help="render no example frames for the guide; those in the dataset are shown in any case",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Serves the page until interrupted, or has programs annotate."""
    from lerobot_roborecover.curation.annotation.annotators import PREFIX, is_automatic
    from lerobot_roborecover.curation.annotation.automatic import annotate
    from lerobot_roborecover.scenario import ScenarioError
    from lerobot_roborecover.web.annotate.serve import AnnotateConfig, serve

    reserved = [name for name in args.annotators if is_automatic(name)]
    if reserved:
        raise ScenarioError(
            f"--annotator {reserved[0]}: names that start with {PREFIX!r} are those of automatic annotators. "
            "Take another, or --automatic"
        )
    if bool(args.annotators) == args.automatic:
        raise ScenarioError("name who annotates with --annotator NAME, or say --automatic")
    try:
        if args.automatic:
            annotate(args.dataset, _say, votes=args.votes, only=args.only)
        else:
            config = AnnotateConfig(
                dataset=args.dataset,
                annotators=args.annotators,
                port=args.port,
                votes=args.votes,
                seed=args.seed,
                only=args.only,
                examples=not args.no_examples,
            )
            serve(config, _say)
    except KeyboardInterrupt:
        # The way to end it; every vote is on disk already.
        print("stopped")
    return 0


def _say(line: str) -> None:
    print(line, flush=True)
