"""`roborecover dataset pull`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "Pull a dataset from the Hugging Face Hub into a new folder: all of it, checked, or nothing."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("repo_id", metavar="ORG/NAME", help="dataset on the Hub")
    add("--revision", help="tag, branch or commit; a commit or a version tag makes results repeatable")
    add("--out", type=Path, required=True, help="new folder")
    add("--evaluation-only", action="store_true", help="meta/roborecover/ alone, without episodes")


def run(args: argparse.Namespace) -> int:
    """Pulls."""
    from lerobot_roborecover.datasets.pull import pull_dataset

    done = pull_dataset(args.repo_id, args.out, revision=args.revision, evaluation_only=args.evaluation_only)
    print(f"{done.root}: {done.files} files, {done.bytes / 1e6:.1f} MB\nrevision {done.commit}")
    return 0
