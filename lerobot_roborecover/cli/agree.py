"""`roborecover agree`."""

from __future__ import annotations

import argparse
from pathlib import Path

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
    add("--license", help="SPDX identifier of that dataset")


def run(args: argparse.Namespace) -> int:
    """Measures, resolves, and writes what was asked for."""
    from lerobot_roborecover.build.agreement import format_agreement
    from lerobot_roborecover.build.annotate.votes import votes_folder
    from lerobot_roborecover.build.candidates import read_candidates
    from lerobot_roborecover.build.funnel import format_funnel, funnel, read_decisions
    from lerobot_roborecover.build.resolution import (
        NOT_PEOPLES,
        ResolutionConfig,
        resolve,
        write_discussion,
        write_resolution,
    )

    candidates = read_candidates(args.dataset)
    config = ResolutionConfig(args.votes_needed, args.tolerance, args.no_consensus)
    found = resolve(candidates, votes_folder(args.dataset, args.votes), config)
    print(f"{len(found.annotators)} annotators: {', '.join(found.annotators)}; round {found.rounds}")
    if NOT_PEOPLES[found.kind]:
        print(NOT_PEOPLES[found.kind])
    print(format_agreement(found.agreement))
    print(", ".join(f"{n} {outcome}" for outcome, n in sorted(found.counts().items())))
    if args.discuss:
        listed = write_discussion(args.discuss, found)
        print(f"{listed} candidates to discuss" + (f" in {args.discuss}" if listed else ""))
    if args.out:
        write_resolution(args.out, candidates, found, config, license=args.license)
        print(f"{found.counts()['kept']} scenarios in {args.out}")
        print(format_funnel(funnel(read_decisions(args.out))))
    return 0
