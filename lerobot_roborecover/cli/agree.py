"""`roborecover curate agree`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.datasets.licenses import license_argument

if TYPE_CHECKING:
    from lerobot_roborecover.curation.agree import AgreeRequest

HELP = "Agreement between annotators, and the scenarios that their votes resolve to."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder of the candidate dataset that was annotated")
    add("--votes", type=Path, metavar="FOLDER", help="of all votes (DATASET/meta/roborecover/votes)")
    add("--votes-needed", type=int, default=3, metavar="N", help="annotators a candidate needs (%(default)s)")
    add(
        "--tolerance", type=int, default=10, metavar="STEPS",
        help="how far apart recovery points may lie that agree (%(default)s)",
    )  # fmt: skip
    add(
        "--no-consensus", choices=("discuss", "drop"), default="discuss",
        help="what becomes of candidates without consensus (%(default)s)",
    )  # fmt: skip
    add("--discuss", type=Path, metavar="LIST", help="write them to this file, for `annotate --only`")
    add("--out", type=Path, metavar="FOLDER", help="write the resolved candidates as a scenario dataset")
    add("--license", type=license_argument, help="licence by the Hub's identifier, of that dataset")


def run(args: argparse.Namespace) -> int:
    """Measures, resolves, and writes what was asked for."""
    from lerobot_roborecover.curation.agree import agree

    agree(request(args), print)
    return 0


def request(args: argparse.Namespace) -> AgreeRequest:
    """Which votes to resolve, from parsed arguments."""
    from lerobot_roborecover.curation.agree import AgreeRequest
    from lerobot_roborecover.curation.resolution import ResolutionConfig

    config = ResolutionConfig(args.votes_needed, args.tolerance, args.no_consensus)
    return AgreeRequest(args.dataset, args.votes, config, args.discuss, args.out, args.license)
