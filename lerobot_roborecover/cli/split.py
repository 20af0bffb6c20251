"""`roborecover curate split`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_roborecover.cli.old_options import renamed

if TYPE_CHECKING:
    from lerobot_roborecover.curation.split import SplitConfig

HELP = "Divide a scenario dataset into splits without leakage, and say how balanced they are."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    add = parser.add_argument
    add("dataset", type=Path, help="folder of a scenario dataset")
    add("--train", metavar="SIZE", help="a count, or a fraction such as 0.8")
    add("--test", metavar="SIZE", help="the same")
    add("--val", metavar="SIZE", help="the same")
    add(
        "--split", dest="others", action="append", default=[], metavar="NAME=SIZE",
        help="a split of another name; repeat it for several",
    )  # fmt: skip
    add("--seed", type=int, default=42, help="of the draw (%(default)s)")
    add(
        "--disjoint-by", metavar="KEYS",
        help="what no two splits may share, of trajectory, record, instruction, start, separated by commas "
        "(trajectory,record; on robotwin also instruction)",
    )  # fmt: skip
    add(
        "--min-per-split", action="append", default=[], metavar="SPLIT:KEY=N",
        help="scenarios of each cell, source or suite that a split has at least, e.g. test:cell=12, where "
        "the set has as many; repeat it for several",
    )  # fmt: skip
    add(
        "--out", type=Path, metavar="FOLDER", help="write a copy there; without it the dataset itself changes"
    )
    add("--dry-run", action="store_true", help="show the splits, and change nothing")
    add(
        "--check", action="store_true", help="report leakage of the splits that are there, and change nothing"
    )
    add("--force", action="store_true", help="divide a dataset anew that was divided before")
    renamed(parser, "--disjoint-by", "--apart")
    renamed(parser, "--min-per-split", "--least")


def run(args: argparse.Namespace) -> int:
    """Divides, or checks, and reports."""
    from lerobot_roborecover.curation.split import parse_apart
    from lerobot_roborecover.curation.split_dataset import (
        check_splits,
        describe,
        format_report,
        split_dataset,
    )

    if args.check:
        report = check_splits(args.dataset, parse_apart(args.disjoint_by))
        print(format_report(report))
        return 1 if report.leaks else 0
    report = split_dataset(args.dataset, config(args), out=args.out, dry_run=args.dry_run, force=args.force)
    if args.dry_run:
        print(f"{format_report(report)}\ndry run: nothing was changed")
    else:
        print(describe(report, args.out or args.dataset))
    return 0


def config(args: argparse.Namespace) -> SplitConfig:
    """How to divide, from parsed arguments."""
    from lerobot_roborecover.curation.split import SplitConfig, parse_apart, parse_least, parse_sizes

    apart = parse_apart(args.disjoint_by)
    named = {"train": args.train, "val": args.val, "test": args.test}
    sizes = parse_sizes({**{k: v for k, v in named.items() if v}, **dict(_pair(o) for o in args.others)})
    return SplitConfig(sizes, args.seed, apart, parse_least(args.min_per_split))


def _pair(text: str) -> tuple[str, str]:
    name, _, size = text.partition("=")
    return name.strip(), size.strip()
