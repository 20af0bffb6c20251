"""Processor time and memory of `roborecover report` on a large study.

    python benchmarks/report_size.py [--policies 5] [--scenarios 2150] [--trials 5] [--keep DIR]

Writes made-up logs (by default 107,500 rows: 5 policies × 2,150 scenarios × 5 trials from both starts), runs
the command in a process of its own, and prints its seconds of processor time and its peak memory.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", type=int, default=5)
    parser.add_argument("--scenarios", type=int, default=2150)
    parser.add_argument("--trials", type=int, default=5, help="from each of the two starts")
    parser.add_argument("--keep", type=Path, help="folder for logs and report, instead of a temporary one")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = args.keep or Path(folder)
        logs = write_logs(root / "logs", args.policies, args.scenarios, args.trials)
        rows = 2 * args.policies * args.scenarios * args.trials
        program = "import sys; from lerobot_roborecover.cli.main import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", program, "report", *logs, "--out", str(root / "report")]
        start = time.perf_counter()
        with open(root / "output.txt", "w") as output:
            done = subprocess.run(
                command, stdout=output, stderr=output, env={**os.environ, "OMP_NUM_THREADS": "1"}
            )
        wall = time.perf_counter() - start
        if done.returncode:
            said = (root / "output.txt").read_text()[-2000:]
            sys.exit(f"the report ended with status {done.returncode}:\n{said}")
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        page = (root / "report" / "report.html").stat().st_size
    print(f"{rows} rows: {used.ru_utime + used.ru_stime:.1f} s of processor time, {wall:.1f} s on the clock,")
    print(f"{used.ru_maxrss / 1024:.0f} MiB at most; a page of {page / 2**20:.1f} MiB")


def write_logs(folder: Path, policies: int, scenarios: int, trials: int) -> list[str]:
    """One log a policy, of different rates; those that are there already are kept."""
    from tests.support.trial_rows import policy_rows, write_log

    logs = []
    for k in range(policies):
        path = folder / f"policy-{k:02d}.jsonl"
        if not path.is_file():
            rate = 0.3 + 0.4 * k / max(1, policies - 1)
            rows = policy_rows(f"policy-{k:02d}", scenarios, trials, rate, k)
            rows += policy_rows(f"policy-{k:02d}", scenarios, trials, 0.9, k + 100, start="initial")
            write_log(path, rows)
        logs.append(str(path))
    return logs


if __name__ == "__main__":
    main()
