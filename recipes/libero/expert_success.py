"""How often LIBERO's scripted expert solves each task from clean starts, as a Markdown table.

    python -m recipes.libero.expert_success --inits 10 --rows expert.jsonl

Finished rollouts are kept in the file of rows, so that a run can be interrupted; after a change to the
controllers, name another file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.starts import Starts, stream
from lerobot_roborecover.scenario import Reset, ScenarioError, Task
from lerobot_roborecover.utils.journal import Journal

_SCHEMA = 1
_INIT_STATES = 50
"""Of every task."""
_KEY = ("expert", "suite", "task", "init_state")
"""Fields that tell rows apart; `steps` is None where the task was not solved."""
_GOOD = 0.8
"""Share of solved starts from which a task counts as solved."""


def spread_inits(count: int) -> tuple[int, ...]:
    """Indices of so many init states, evenly over the stored ones."""
    return tuple(np.linspace(0, _INIT_STATES - 1, count).round().astype(int).tolist())


def solve(simulator: LiberoSimulator, task: Task, reset: Reset, expert: str) -> int | None:
    """Steps in which a scripted expert solves a task, or None where the budget ends first.

    Args:
        simulator: reset here.
        task: what to drive.
        reset: where from; its settling steps do not count.
        expert: name among the platform's.
    """
    simulator.reset(task, reset)
    for _ in range(reset.settle_steps):
        simulator.step(PLATFORM.no_op())
    rng = stream(reset.seed or 0, "expert_success", task, reset)
    act = PLATFORM.experts[expert].make(simulator, task, rng)
    for step in range(task.horizon):
        simulator.step(act(step))
        if simulator.succeeded():
            return step + 1
    return None


def tasks_named(listed: str) -> list[Task]:
    """Tasks by `suite:number`, comma-separated, the number as in hf-libero's list; all for an empty list.

    Raises:
        ScenarioError: there is no such task.
    """
    numbered = _numbered()
    if not listed:
        return list(numbered.values())
    wanted = [name if ":" in name else f"{name}:" for name in listed.split(",")]
    found = [
        t for k, t in numbered.items() if any(k == w or (w[-1] == ":" and k.startswith(w)) for w in wanted)
    ]
    if not found:
        raise ScenarioError(f"--tasks {listed}: there are {', '.join(numbered)}")
    return found


def table(tasks: Iterable[Task], rows: Iterable[Mapping[str, Any]]) -> str:
    """Solved of tried and mean steps of the solved, one line per task, and a total."""
    rows, names = list(rows), {task: key for key, task in _numbered().items()}
    lines = ["| Task | Instruction | Solved | Mean steps | Budget |", "|---|---|---:|---:|---:|"]
    good = count = 0
    for task in tasks:
        mine = [r["steps"] for r in rows if (r["suite"], r["task"]) == (task.suite, task.name)]
        steps = [s for s in mine if s is not None]
        mean = f"{np.mean(steps):.0f}" if steps else ""
        count += 1
        good += bool(mine) and len(steps) >= _GOOD * len(mine)
        lines.append(
            f"| {names[task]} | {task.instruction} | {len(steps)}/{len(mine)} | {mean} | {task.horizon} |"
        )
    return "\n".join(
        [*lines, "", f"{good} of {count} tasks are solved from at least {_GOOD:.0%} of their starts."]
    )


def _numbered() -> dict[str, Task]:
    of_suite: dict[str, list[Task]] = {}
    for task in PLATFORM.tasks():
        of_suite.setdefault(task.suite, []).append(task)
    return {
        f"{s.removeprefix('libero_')}:{i}": t for s, tasks in of_suite.items() for i, t in enumerate(tasks)
    }


def main(argv: list[str] | None = None) -> int:
    """Runs the command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m recipes.libero.expert_success")
    parser.add_argument("--inits", type=int, default=10, help="init states per task, spread over the fifty")
    parser.add_argument("--tasks", default="", help="suites or tasks, e.g. spatial,goal:0,10:3; default all")
    parser.add_argument("--rows", type=Path, default=Path("expert_success.jsonl"), help="finished rollouts")
    parser.add_argument("--expert", default="scripted", choices=sorted(PLATFORM.experts))
    parser.add_argument("--assets-dir", default=None, help="LIBERO's assets")
    args = parser.parse_args(argv)
    tasks = tasks_named(args.tasks)
    starts = Starts(init_states=spread_inits(args.inits))
    simulator = LiberoSimulator(assets_dir=args.assets_dir, obs_type="state")
    with Journal(args.rows, _SCHEMA) as journal:
        rows = {(r["expert"], r["suite"], r["task"], r["init_state"]): r for r in journal.records}
        wanted = []
        for task in tasks:
            for reset in PLATFORM.resets(task, starts):
                key = (args.expert, task.suite, task.name, reset.init_state_index)
                if key not in rows:
                    steps = solve(simulator, task, reset, args.expert)
                    rows[key] = dict(zip(_KEY, key, strict=True), steps=steps)
                    journal.append(rows[key])
                    print(*key, "fails" if steps is None else steps, file=sys.stderr, flush=True)
                wanted.append(rows[key])
    simulator.close()
    print(table(tasks, wanted))
    return 0


if __name__ == "__main__":
    sys.exit(main())
