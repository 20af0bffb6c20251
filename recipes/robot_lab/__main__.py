"""Command line of the study."""

from __future__ import annotations

import argparse
import gzip
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lerobot_roborecover.analysis.tables import Table
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.utils.atomic_io import atomic_write
from recipes import robot_lab
from recipes.outcomes import OUTCOMES
from recipes.robot_lab import comparisons, results, start_errors
from recipes.robot_lab.bench import POINTS, POLICIES, Bench, policy

FILES = {
    "start_errors": "start_errors.jsonl",
    "restored": "restored/trials.jsonl",
    "true_errors": "restored/true_errors.jsonl",
    "aa": "aa/trials.jsonl",
    "exact": "exact.jsonl",
}
"""Outcomes by the name under which they are kept with the code."""
STORED = OUTCOMES / "robot_lab"


def run(part: str, out: Path) -> None:
    """Runs one part; goes on where it stopped."""
    if part == "a":
        start_errors.run(out)
        return
    cv2.setNumThreads(1)
    bench = Bench(out / "standard", {})
    checkpoints = {name: policy(bench.out, name, bias) for name, bias in POLICIES.items()}
    if part == "c":
        names = dict.fromkeys(comparisons.AA_NAMES, checkpoints[comparisons.AA_POLICY])
        comparisons.restored(bench, out / "aa", names, comparisons.AA_REPEATS, comparisons.AA_POINTS)
        return
    comparisons.exact(bench, out / FILES["exact"], (0.0,) if part == "b" else (0.0, *comparisons.OFFSETS_MM))
    if part == "b":
        comparisons.restored(bench, out / "restored", checkpoints, comparisons.REPEATS, POINTS)


def tables(part: str, files: dict[str, Path]) -> list[Table]:
    """The tables of one part."""
    if part == "a":
        return results.part_a(records(files["start_errors"]))
    if part == "c":
        return results.part_c(read_trial_log(files["aa"]))
    if part == "d":
        return results.part_d(records(files["exact"]))
    true_mm = np.array([r["true_mm"] for r in records(files["true_errors"])])
    return results.part_b(read_trial_log(files["restored"]), true_mm, records(files["exact"]))


def records(path: Path) -> list[dict[str, Any]]:
    """Records of a file of JSON lines, compressed or not."""
    data = path.read_bytes()
    text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode()
    return [json.loads(line) for line in text.splitlines()]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=robot_lab.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--part", choices="abcd", help="runs this part; by default none")
    add("--out", type=Path, required=True, help="folder to work in; a rerun goes on there")
    add("--store", action="store_true", help="keep the outcomes of all parts with the code")
    add("--stored", action="store_true", help="run nothing: the tables of the outcomes kept with the code")
    args = parser.parse_args()
    if args.part and not args.stored:
        run(args.part, args.out)
    files = {name: args.out / path for name, path in FILES.items()}
    if args.store:
        for name, path in files.items():
            data = path.read_bytes().replace(f"{args.out}/".encode(), b"")  # not where it was run
            atomic_write(STORED / f"{name}.jsonl.gz", gzip.compress(data, mtime=0))
    if args.stored:
        files = {name: STORED / f"{name}.jsonl.gz" for name in FILES}
    for part in args.part or "abcd":
        results.write(args.out / "tables", tables(part, files))
    if args.stored or not args.part:
        drawn = results.figure(records(files["start_errors"]), records(files["exact"]))
        atomic_write(args.out / "tables" / "robot_lab.svg", drawn)


if __name__ == "__main__":
    main()
