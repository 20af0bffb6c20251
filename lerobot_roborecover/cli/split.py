"""`roborecover split`."""

from __future__ import annotations

import argparse
from pathlib import Path

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
        "--apart", metavar="KEYS",
        help="what no two splits may share, of trajectory, record, instruction, separated by commas "
        "(trajectory,record; on robotwin also instruction)",
    )  # fmt: skip
    add(
        "--out", type=Path, metavar="FOLDER", help="write a copy there; without it the dataset itself changes"
    )
    add("--dry-run", action="store_true", help="show the splits, and change nothing")
    add(
        "--check", action="store_true", help="report leakage of the splits that are there, and change nothing"
    )
    add("--force", action="store_true", help="divide a dataset anew that was divided before")


def run(args: argparse.Namespace) -> int:
    """Divides, or checks, and reports."""
    from lerobot_roborecover.curation.attrition import attrition_table, count_stages, read_decisions
    from lerobot_roborecover.curation.split import SplitConfig, parse_apart, parse_sizes
    from lerobot_roborecover.curation.split_dataset import check_splits, format_report, split_dataset
    from lerobot_roborecover.words import next_line

    apart = parse_apart(args.apart)
    if args.check:
        report = check_splits(args.dataset, apart)
        print(format_report(report))
        return 1 if report.leaks else 0
    named = {"train": args.train, "val": args.val, "test": args.test}
    sizes = parse_sizes({**{k: v for k, v in named.items() if v}, **dict(_pair(o) for o in args.others)})
    config = SplitConfig(sizes, args.seed, apart)
    report = split_dataset(args.dataset, config, out=args.out, dry_run=args.dry_run, force=args.force)
    print(format_report(report))
    if args.dry_run:
        print("dry run: nothing was changed")
    elif rows := count_stages(read_decisions(args.out or args.dataset)):
        print(attrition_table(rows))
    if not args.dry_run:
        print(next_line(["render", str(args.out or args.dataset), "--out", "RENDERED"]))
    return 0


def _pair(text: str) -> tuple[str, str]:
    name, _, size = text.partition("=")
    return name.strip(), size.strip()
