"""How often every printed interval holds what it speaks of, and how often every printed test is wrong.

    python benchmarks/coverage.py                      # table of docs/log/statistics.md, minutes on one core
    python benchmarks/coverage.py --replicates 200     # a first look
    python benchmarks/coverage.py --only rates         # one part: see --help
    python benchmarks/coverage.py --worst              # and the worst setting of each line

Made-up policies with known rates: n scenarios of equal difficulty, or beta-distributed ones (concentration 4
and 1, a little and much scatter), 1 or 5 trials each, rates from .02 to .98; with and without tasks, whose
rates scatter too; scenarios that share first states; monitors whose scenarios are hard and easy; annotators
who err. Each interval is held against its own estimand: scenarios like these of these tasks, or tasks like
these. Exit status 1 where an interval covers below 90 % at n = 8 or below 92 % from n = 20 on, or a family of
15 pairs is wrong more often than 6 %. Seeded; every setting has draws of its own. What takes long is measured
on fewer samples: a fourth of --replicates for what is cross-fitted, an eighth for monitors (a sixteenth at
n = 200), a sixteenth for rank inversions, runs of a method and tests that are looked at.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np

if __name__ == "coverage":
    # The library of this name is asked for by numba, and a script's own folder comes first on the path.
    raise ImportError("this is a benchmark, and not the library coverage")

sys.path.insert(0, str(Path(__file__).resolve().parent))

import coverage_first_states as shared
import coverage_labels as labels
import coverage_policies as policies
import coverage_runs as several
import coverage_settings as settings
from coverage_settings import SIZES, Line

PARTS = {
    "rates": settings.rates,
    "retries": settings.retries,
    "tasks": settings.with_tasks,
    "macro": settings.macro,
    "differences": settings.differences,
    "ratios": settings.ratios,
    "steps": settings.steps,
    "chosen": policies.chosen,
    "monitor": labels.monitors,
    "agreement": labels.annotators,
    "runs": several.runs,
    "looks": several.looks,
    "ranks": policies.ranks,
    "tests": settings.tests,
    "first_states": shared.first_states,
    "bootstrap": settings.bootstrap,
}
NOT_PRINTED = (
    "rate, percentile bootstrap",
    "rho, percentile bootstrap",
    "rate, hierarchical bootstrap",
    "the same, from these runs alone",
    "a fixed test at every look",
    "initial rate, over scenarios",
    "one initial pair, over scenarios",
    "the same, planned for what is there",
)
"""For comparison: no target."""
LEAST = {8: 0.90, 20: 0.92, 64: 0.92, 200: 0.92}
MOST_WRONG = 0.06


def too_far(lines: list[Line], slack: float = 0.0) -> list[Line]:
    """Settings that miss the targets.

    Args:
        lines: measured.
        slack: what the number of replicates may hide.
    """
    found = []
    for line in lines:
        if line.what in NOT_PRINTED:
            continue
        if line.size and line.share > MOST_WRONG + slack:
            found.append(line)
        if not line.size and line.share < LEAST[line.n] - slack:
            found.append(line)
    return found


def table(lines: list[Line], worst: bool) -> str:
    """Markdown: smallest coverage (largest error of a test) over all settings, and the mean."""
    head = ["", *(f"n = {n}" for n in SIZES), *(["worst at"] if worst else [])]
    rows = [head, ["---"] * len(head)]
    for what in dict.fromkeys(line.what for line in lines):
        cells = [what]
        every = [line for line in lines if line.what == what]
        for n in SIZES:
            own = [line for line in every if line.n == n]
            if not own:
                cells.append("")
                continue
            mean = np.mean([line.share for line in own])
            cells.append(f"{100 * _edge(own).share:.1f} ({100 * mean:.1f})")
        edge = _edge(too_far(every) or every)
        rows.append([*cells, *([f"n = {edge.n}: {edge.setting}"] if worst else [])])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def small_cells(replicates: int) -> str:
    """Markdown: least coverage of Macro and its mean width, by the size of its smallest cell."""
    rows = ["| smallest cell | least coverage | mean width, points |", "|---|---|---|"]
    for size in range(1, 13):
        lines = list(settings.small_cell(replicates, size))
        width = 100 * np.mean([line.width for line in lines])
        rows.append(f"| {size} | {100 * _edge(lines).share:.1f} % | {width:.1f} |")
    return "\n".join(rows)


def _edge(lines: list[Line]) -> Line:
    """The worst of them."""
    return max(lines, key=lambda x: x.share) if lines[0].size else min(lines, key=lambda x: x.share)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=4000, help="samples of each setting (%(default)s)")
    parser.add_argument("--only", action="append", choices=PARTS, help="this part; may be given again")
    parser.add_argument("--worst", action="store_true", help="with the worst setting of each line")
    parser.add_argument(
        "--small-cells", action="store_true", help="Macro by the size of its smallest cell, and nothing else"
    )
    args = parser.parse_args()
    if args.small_cells:
        print(small_cells(args.replicates))
        return 0
    lines: list[Line] = []
    for name in args.only or PARTS:
        start = time.process_time()
        lines += PARTS[name](args.replicates)
        spent = time.process_time() - start
        print(f"{name}: {spent:.0f} s, {len(lines)} settings so far", file=sys.stderr, flush=True)
    print(table(lines, args.worst))
    misses = 0
    for line in too_far(lines):
        surely = bool(too_far([line], slack=2 * _standard_error(line)))
        word = "misses" if surely else "beyond the target by no more than two standard errors of its samples"
        misses += surely
        print(f"{word}: {line.what}, n = {line.n}, {line.setting}: {100 * line.share:.1f} %")
    return int(bool(misses))


def _standard_error(line: Line) -> float:
    share = MOST_WRONG if line.size else LEAST[line.n]
    return math.sqrt(share * (1 - share) / line.samples)


if __name__ == "__main__":
    sys.exit(main())
