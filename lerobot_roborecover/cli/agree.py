"""`roborecover agree`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.datasets.licenses import license_argument

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
    from lerobot_roborecover.curation.agreement import format_agreement
    from lerobot_roborecover.curation.annotation.votes import votes_folder
    from lerobot_roborecover.curation.attrition import attrition_table, count_stages, read_decisions
    from lerobot_roborecover.curation.candidates import read_candidates
    from lerobot_roborecover.curation.resolution import (
        NOT_PEOPLES,
        ResolutionConfig,
        resolve,
        write_discussion,
        write_resolution,
    )
    from lerobot_roborecover.words import counted, next_line

    candidates = read_candidates(args.dataset)
    config = ResolutionConfig(args.votes_needed, args.tolerance, args.no_consensus)
    found = resolve(candidates, votes_folder(args.dataset, args.votes), config)
    print(
        f"{counted(len(found.annotators), 'annotator')}: {', '.join(found.annotators)}; round {found.rounds}"
    )
    if NOT_PEOPLES[found.kind]:
        print(NOT_PEOPLES[found.kind])
    print(format_agreement(found.agreement))
    print(", ".join(f"{n} {outcome}" for outcome, n in sorted(found.counts().items())))
    if args.discuss:
        listed = write_discussion(args.discuss, found)
        print(f"{counted(listed, 'candidate')} to discuss" + (f" in {args.discuss}" if listed else ""))
    if args.out:
        write_resolution(args.out, candidates, found, config, license=args.license)
        print(f"{counted(found.counts()['kept'], 'scenario')} in {args.out}")
        print(attrition_table(count_stages(read_decisions(args.out))))
        print(next_line(["screen", str(args.out), "--policy", "CHECKPOINT", "--out", "SCREENED"]))
    return 0
