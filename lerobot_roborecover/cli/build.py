"""`roborecover curate build`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from lerobot_roborecover.utils.determinism import pin_policy_kernels

HELP = (
    "Build a scenario dataset from one YAML file: collect, annotate, agree, screen, validate, split, render."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("config", type=Path, help="the YAML file, e.g. policies/build/metaworld.yaml")
    add(
        "--from", dest="first", default="", metavar="STAGE",
        help="run this stage and all after it, changed or not: collect, join, annotate, agree, screen, "
        "validate, split, render, publish",
    )  # fmt: skip
    add("--until", default="", metavar="STAGE", help="stop after this stage")
    add("--dry-run", action="store_true", help="say what would run, and run nothing")


def run(args: argparse.Namespace) -> int:
    """Builds, writes the summary, and prints the funnel."""
    pin_policy_kernels()  # outcomes of these trials are compared with those of a study
    from lerobot_roborecover.curation.pipeline.check import check_build
    from lerobot_roborecover.curation.pipeline.config import read_config
    from lerobot_roborecover.curation.pipeline.stages import AwaitingAnnotations, Pipeline
    from lerobot_roborecover.curation.pipeline.summary import write_summary
    from lerobot_roborecover.curation.pipeline.work import StageRunners
    from lerobot_roborecover.curation.render import publish_next
    from lerobot_roborecover.utils.text import next_command

    config = read_config(args.config)
    if problems := check_build(config):
        listed = "\n".join(f"  - {problem}" for problem in problems)
        print(f"{args.config} cannot be built, and nothing was run:\n{listed}", file=sys.stderr)
        if not args.dry_run:
            return 2
    chain = Pipeline(config, StageRunners(), lambda line: print(line, flush=True))
    waiting = ""
    try:
        done = chain.build(args.first, args.until, args.dry_run)
    except AwaitingAnnotations as err:
        waiting, done = str(err), []
    if args.dry_run:
        return 2 if problems else 0
    if text := write_summary(chain.places, args.config, done):
        print(f"\n{text}\n\nsummary in {chain.places.summary}")
    if waiting:
        print(f"\nstopped: {waiting}")
        return 1
    if config.publish is None and not args.until:
        print("\n" + next_command(publish_next(chain.places.result), "to publish"))
    return 0
