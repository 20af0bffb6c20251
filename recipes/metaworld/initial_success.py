"""Measures how often Meta-World policies solve tasks from initial states, before recovery is measured.

python -m recipes.metaworld.initial_success CHECKPOINT ... --trials 10
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.platforms.metaworld import PLATFORM
from lerobot_roborecover.platforms.metaworld.catalog import HORIZON
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.scenario import Reset
from recipes.learned import LearnedPolicy
from recipes.metaworld.dataset import STUDY_TASKS

FIRST_SEED = 5_000
"""Below the demonstrations' seeds, above the scenarios'."""


@dataclass(frozen=True)
class Tried:
    """What became of a task's trials."""

    solved: int
    trials: int
    actions: int
    """Asked of the policy in all."""
    policy_s: float
    """Processor time of the policy, its processors included, in all."""


def evaluate(checkpoint: Path, tasks: Iterable[str], trials: int) -> dict[str, Tried]:
    """Tries a policy on each task from fresh resets; prints a line a task.

    Args:
        checkpoint: folder of a policy that reads the low-dimensional state.
        tasks: names.
        trials: resets of each.
    """
    import torch

    simulator = MetaworldSimulator(obs_type="state")
    found = {}
    for name in tasks:
        task, solved, actions, policy_s = PLATFORM.task(name), 0, 0, 0.0
        act = LearnedPolicy(simulator, task, str(checkpoint))
        for trial in range(trials):
            seed = FIRST_SEED + trial
            simulator.reset(task, Reset(seed=seed))
            act.reset()
            torch.manual_seed(seed)
            for t in range(HORIZON):
                began = time.process_time()
                action = act(t)
                policy_s += time.process_time() - began
                actions += 1
                simulator.step(action)
                if simulator.succeeded():
                    solved += 1
                    break
        found[name] = Tried(solved, trials, actions, policy_s)
        print(f"{checkpoint.name}: {name} {solved}/{trials}", flush=True)
    simulator.close()
    return found


def table(found: Mapping[str, Mapping[str, Tried]]) -> str:
    """Markdown: solved trials by task and policy, their share, and the policy's milliseconds an action."""
    tasks = list(dict.fromkeys(task for tried in found.values() for task in tried))
    lines = ["| task | " + " | ".join(found) + " |", "|---" * (len(found) + 1) + "|"]
    for task in tasks:
        cells = [f"{tried[task].solved}/{tried[task].trials}" for tried in found.values()]
        lines.append(f"| {task.removesuffix('-v3')} | " + " | ".join(cells) + " |")
    share = [_sum(t, "solved") / _sum(t, "trials") for t in found.values()]
    lines.append("| all | " + " | ".join(f"{100 * value:.0f} %" for value in share) + " |")
    pace = [1000 * _sum(t, "policy_s") / _sum(t, "actions") for t in found.values()]
    lines.append("| ms an action | " + " | ".join(f"{value:.1f}" for value in pace) + " |")
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoints", type=Path, nargs="+", help="folders")
    parser.add_argument("--tasks", nargs="+", default=list(STUDY_TASKS))
    parser.add_argument("--trials", type=int, default=10, help="resets of each task")
    args = parser.parse_args()
    print(table({path.name: evaluate(path, args.tasks, args.trials) for path in args.checkpoints}))


def _sum(tried: Mapping[str, Tried], field: str) -> float:
    return sum(getattr(one, field) for one in tried.values())


if __name__ == "__main__":
    main()
