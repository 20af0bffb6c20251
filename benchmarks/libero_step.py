"""LIBERO: a control step without pictures, with this package's shortcuts and by robosuite's own code.

    python benchmarks/libero_step.py                    # a minute
    python benchmarks/libero_step.py --every            # all forty tasks

Both take the same random actions from the same states, in short turns one after the other; their states are
compared bit for bit at the end of each. Printed are CPU milliseconds of this thread, which other work on the
machine moves less than the clock: medians over a task's turns, of `step`, `observe` (the state
observations) and `succeeded`, and of the turns' ratios.
"""

from __future__ import annotations

import argparse
import statistics
import time

from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

import numpy as np  # isort: skip - after lerobot_roborecover, which pins how it rounds (docs/log/exactness.md)

PARTS = ("step", "observe", "succeeded")


def turn(simulator: LiberoSimulator, actions: np.ndarray) -> np.ndarray:
    """Milliseconds per control step of each of `PARTS`."""
    spent = np.zeros(len(PARTS))
    for action in actions:
        marks = [time.thread_time()]
        for call in (lambda a=action: simulator.step(a), simulator.observe, simulator.succeeded):
            call()
            marks.append(time.thread_time())
        spent += np.diff(marks)
    return 1e3 * spent / len(actions)


def main() -> None:
    """Prints a row for each task, and the medians over tasks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--every", action="store_true", help="all tasks, not two of each suite")
    parser.add_argument("--steps", type=int, default=40, help="of a turn")
    parser.add_argument("--turns", type=int, default=8, help="of each way, on each task")
    args = parser.parse_args()
    simulator = LiberoSimulator(obs_type="state")
    tasks = PLATFORM.tasks()
    rows = [measure(simulator, task, args.steps, args.turns) for task in tasks[:: 1 if args.every else 5]]
    print(line("median", *np.median(rows, axis=0)))
    simulator.close()


def measure(simulator: LiberoSimulator, task, steps: int, turns: int) -> np.ndarray:
    """Of one task: `PARTS` with shortcuts, `PARTS` without, ratio of the steps, ratio of the sums."""
    simulator.reset(task, PLATFORM.first_reset(task))
    rng = np.random.default_rng(0)
    warm, actions = rng.uniform(-1, 1, (2, steps, simulator.action_dim))
    built = simulator._task
    for shortcuts in (False, True):
        built.use_shortcuts(shortcuts)
        turn(simulator, warm[:5])
    start, found = simulator.snapshot(), []
    for number in range(turns):
        taken, ends = {}, set()
        for shortcuts in (True, False) if number % 2 else (False, True):
            built.use_shortcuts(shortcuts)
            simulator.restore(start)
            taken[shortcuts] = turn(simulator, actions)
            ends.add(simulator.state_sha256())
        assert len(ends) == 1, f"{task.name}: other states"
        ours, theirs = taken[True], taken[False]
        found.append([*ours, *theirs, theirs[0] / ours[0], theirs.sum() / ours.sum()])
    numbers = np.array([statistics.median(column) for column in zip(*found, strict=True)])
    print(line(f"{task.suite}/{task.name}"[:48], *numbers), flush=True)
    return numbers


def line(name: str, *numbers: float) -> str:
    """A row: milliseconds, then ratios."""
    ours, theirs, ratios = numbers[:3], numbers[3:6], numbers[6:]
    parts = (" ".join(f"{n:6.2f}" for n in part) for part in (ours, theirs, ratios))
    return (
        f"{name:48} ours {next(parts)} ms  robosuite's {next(parts)} ms  ratio of step, of all {next(parts)}"
    )


if __name__ == "__main__":
    main()
