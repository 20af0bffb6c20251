"""The engine's schedule by itself, on a clock of its own: no load of this machine changes these numbers.

    python benchmarks/eval_schedule.py

The engine runs as it is; simulators and policy only say how long they take. Simulators share cores, and each
command takes 3 % more or less than it should. Columns: wall time over max(simulator time / cores, policy
time), wall time over what one slot's chunks take in sequence, milliseconds per chunk, and mean batch.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.evaluation.test_schedule import schedule


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cores", type=int, default=8)
    parser.add_argument("--latency", type=float, default=0.1, help="of an inference, seconds")
    parser.add_argument("--each", type=float, default=0.0, help="more for each slot in the batch, seconds")
    args = parser.parse_args()
    print("slots  trials' steps  over bound  over chain  ms/chunk  batch")
    for slots in (args.cores, 2 * args.cores, 3 * args.cores):
        for shortest in (100, 20):
            world, host = schedule(slots, args.cores, args.latency, args.each, shortest)
            chunks = sum(host.batches)
            bound = max(world.core_s / args.cores, host.busy_s)
            chain = (world.core_s + sum((args.latency + args.each * b) * b for b in host.batches)) / slots
            steps = "100" if shortest == 100 else f"{shortest} to 100"
            print(
                f"{slots:5}  {steps:13}  {world.now / bound:10.3f}  {world.now / chain:10.3f}  "
                f"{1e3 * world.now / chunks:8.1f}  {statistics.mean(host.batches):5.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
