"""`roborecover build`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Build a scenario dataset from one YAML file: collect, annotate, agree, screen, validate, split."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("config", type=Path, help="the YAML file, e.g. policies/build/metaworld.yaml")
    add(
        "--from", dest="first", default="", metavar="STAGE",
        help="run this stage and all after it, changed or not: collect, join, annotate, agree, screen, "
        "validate, split, publish",
    )  # fmt: skip
    add("--until", default="", metavar="STAGE", help="stop after this stage")
    add("--dry-run", action="store_true", help="say what would run, and run nothing")


def run(args: argparse.Namespace) -> int:
    """Builds, writes the summary, and prints the funnel."""
    import shlex

    from lerobot_roborecover.build.chain.commands import publish_command
    from lerobot_roborecover.build.chain.config import read_config
    from lerobot_roborecover.build.chain.stages import Chain, Waiting
    from lerobot_roborecover.build.chain.summary import write_summary
    from lerobot_roborecover.cli.main import main

    config = read_config(args.config)
    chain = Chain(config, lambda argv: main(argv), lambda line: print(line, flush=True))
    waiting = ""
    try:
        done = chain.build(args.first, args.until, args.dry_run)
    except Waiting as err:
        waiting, done = str(err), []
    if args.dry_run:
        return 0
    if text := write_summary(chain.places, args.config, done):
        print(f"\n{text}\n\nsummary in {chain.places.summary}")
    if waiting:
        print(f"\nstopped: {waiting}")
        return 1
    if config.publish is None and not args.until:
        print(f"\nto publish: roborecover {shlex.join(publish_command(config, chain.places))}")
    return 0
