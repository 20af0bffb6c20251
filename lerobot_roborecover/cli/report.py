"""`roborecover report`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from lerobot_roborecover.cli.old_options import renamed

HELP = (
    "Turn trial logs into a report: tables with intervals, figures and a scenario gallery in one "
    "HTML file that "
    "opens from disk, and the same as Markdown, CSV, LaTeX, SVG, PNG and JSON."
)


def add_log_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that say which trials, and how they are resampled; shared by the commands on trial logs."""
    add = parser.add_argument
    add(
        "logs",
        nargs="+",
        metavar="[NAME=]LOG[,LOG]",
        help="trial log, or a folder that holds trials.jsonl; NAME replaces the policy's own name; several "
        "after one NAME are runs of one method",
    )
    add("--platform", help="take this platform's rows only")
    add(
        "--shared-scenarios-only",
        action="store_true",
        help="rank all policies on the scenarios that all were run on (default: those that were run on all)",
    )
    add(
        "--baseline",
        help="policy that interventions are compared with, where it does not follow from the logs",
    )
    add(
        "--intervention",
        action="append",
        default=[],
        metavar="NAME",
        help="treat this policy as an intervention although no trial of it shows one; may be given again",
    )
    add_draws_arguments(parser)
    renamed(parser, "--shared-scenarios-only", "--common")


def add_draws_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the resampling."""
    add = parser.add_argument
    add(
        "--trials",
        type=int,
        help="trials scheduled per recovery point; those without a row then count as failures",
    )
    add("--draws", type=int, default=10_000, help="bootstrap draws (%(default)s)")
    add("--seed", type=int, default=0, help="seed of the draws (%(default)s)")
    add("--level", type=float, default=0.95, help="confidence level (%(default)s)")
    add(
        "--cluster",
        choices=("scenario", "trajectory", "first_state", "task"),
        help="what intervals and tests take as independent; task: the numbers speak of other tasks like "
        "these (default: as the paper, trajectory on RoboTwin, else scenario; initial-state trials: first "
        "states)",
    )


def analysis_options(args: argparse.Namespace):
    """`Options` from the arguments above and those that a command has of the rest."""
    from lerobot_roborecover.analysis.options import Options
    from lerobot_roborecover.analysis.stats.units import ResamplingUnit

    return Options(
        args.draws,
        args.seed,
        args.level,
        args.trials,
        getattr(args, "baseline", None),
        tuple(getattr(args, "intervention", ())),
        ResamplingUnit(args.cluster) if args.cluster else None,
        getattr(args, "shared_scenarios_only", False),
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add_log_arguments(parser)
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/report"), help="folder of the report (%(default)s)")
    add("--title", default="Recovery report", help="heading of the report (%(default)s)")
    add(
        "--scenarios",
        help="the evaluated scenario set (shipped name, folder, Hub id): checks the logs against it",
    )
    add("--revision", help="commit, tag or branch of that set on the Hub")
    add(
        "--render",
        action="store_true",
        help="render recovery frames that the set does not hold (runs the simulator)",
    )
    add(
        "--videos",
        action="append",
        default=[],
        metavar="[NAME=]DIR",
        help="videos of lerobot-eval for the gallery, named after the policy; may be given again",
    )
    add("--videos-mb", type=int, default=64, help="take in at most so many megabytes of video (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Writes the report and prints its headline."""
    from lerobot_roborecover.analysis.make import Gallery, report

    made = report(
        args.logs,
        args.out,
        platform=args.platform,
        title=args.title,
        options=analysis_options(args),
        gallery=Gallery(args.scenarios, args.revision, args.render, args.videos, args.videos_mb),
        command=shlex.join(["roborecover", *sys.argv[1:]]),
    )
    for remark in made.remarks:
        print(f"note: {remark}", file=sys.stderr)
    print(made.text())
    return 0
