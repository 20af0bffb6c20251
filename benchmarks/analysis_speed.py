"""How long a report takes: 12 policies × 200 scenarios × 5 trials, both starts, all intervals and pairs.

    python benchmarks/analysis_speed.py [--policies 12] [--scenarios 200] [--trials 5]
    python benchmarks/analysis_speed.py --policies 120 --scenarios 20 --trials 2    # many pairs

Prints seconds, and seconds of processor time, from log files on disk: reading and checking, all tables
(10,000 draws), all figures and files.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", type=int, default=12)
    parser.add_argument("--scenarios", type=int, default=200)
    parser.add_argument("--trials", type=int, default=5)
    args = parser.parse_args()
    from lerobot_roborecover.analysis.analyse import analyse
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.pages.report import write_report
    from lerobot_roborecover.analysis.report_tables import all_tables
    from tests.support.trial_rows import policy_rows, write_log

    with tempfile.TemporaryDirectory() as folder:
        root, logs = Path(folder), []
        for k in range(args.policies):
            rate = 0.3 + 0.4 * k / max(1, args.policies - 1)
            rows = policy_rows(f"policy-{k:02d}", args.scenarios, args.trials, rate, k)
            rows += policy_rows(f"policy-{k:02d}", args.scenarios, args.trials, 0.9, k + 100, start="initial")
            logs.append(str(write_log(root / f"{k}.jsonl", rows)))
        marks = [_now()]
        study = read_study(logs)
        marks.append(_now())
        results = analyse(study)
        tables = all_tables(results)
        marks.append(_now())
        write_report(results, root / "out")
        marks.append(_now())
    pairs = args.policies * (args.policies - 1) // 2
    print(f"{sum(len(arm.rows) for arm in study.arms)} trials, {len(tables)} tables, {pairs} pairs")
    print(f"{len(results.shown_pairs)} of them drawn and dealt; {_memory_mb()} MB at most")
    for title, first, last in (
        ("read and check", 0, 1),
        ("all tables", 1, 2),
        ("tables again, figures, files", 2, 3),
        ("from logs to all intervals", 0, 2),
    ):
        wall, processor = (marks[last][k] - marks[first][k] for k in range(2))
        print(f"{title:<30}{wall:6.1f} s  {processor:6.1f} s of processor time")


def _memory_mb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


if __name__ == "__main__":
    main()
