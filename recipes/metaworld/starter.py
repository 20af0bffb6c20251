"""The Meta-World scenario set that ships with the package: collect, find recovery points, prove, select,
write.

    python -m recipes.metaworld.starter --out WORK --weak-policy CHECKPOINT
    python -m recipes.metaworld.starter --out WORK --sheets        # pictures to look at
    python -m recipes.metaworld.starter --out WORK --write DATASET

Each stage appends to a file below `--out` and skips what is there: an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.rollout import record
from lerobot_roborecover.platforms.base import Controller
from lerobot_roborecover.platforms.metaworld import PLATFORM
from lerobot_roborecover.platforms.metaworld.catalog import HORIZON
from lerobot_roborecover.platforms.metaworld.experts import (
    biased_expert,
    expert,
    patient_expert,
    weak_grip_expert,
)
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.platforms.simulator import advance
from lerobot_roborecover.replay.handoff import with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, Source
from lerobot_roborecover.utils.journal import append_records, plain_records
from recipes.learned import LearnedPolicy
from recipes.metaworld.dataset import DEMO_TASKS
from recipes.metaworld.labels import recovery_point, watch
from recipes.metaworld.review import DROPPED

ROLLOUT_STEPS = 400
WEAK_POLICY = "act_metaworld_weak"
PROOF_SEEDS = (1, 2)
"""Seeds of the patient expert's attempts at proving a candidate recoverable."""


@dataclass(frozen=True)
class Limits:
    """How large a set gets."""

    repeats: int = 1
    """Rollouts, in multiples of the shipped set's."""
    proven: int = 2
    """Proven candidates after which a group of task, cell and source has enough."""
    tried: int = 4
    """Candidates of a group that are tried, at most."""
    per_task: int = 7
    """Most scenarios of the set that share a task."""
    per_cell: int = 8
    per_task_and_cell: int = 3


SHIPPED = Limits()
TRAINING = Limits(repeats=2, proven=6, tried=10, per_task=40, per_cell=80, per_task_and_cell=12)
"""Of a set to train Correction and monitors on."""


@dataclass(frozen=True)
class Collection:
    """Who drives, and whether its actions are perturbed."""

    source: Source
    policy: str
    make: Callable[[MetaworldSimulator, str, np.random.Generator], Controller]
    seeds: range
    """Of the rollouts of each task."""


def collections(weak_policy: str | None, first_seed: int = 0, limits: Limits = SHIPPED) -> list[Collection]:
    """What is rolled out; the learned policy's part only with its checkpoint.

    Args:
        weak_policy: its checkpoint, if any.
        first_seed: smallest seed; another set than the shipped one starts at 1,000 or later.
        limits: of the set.
    """

    def seeds(count: int) -> range:
        return range(first_seed, first_seed + limits.repeats * count)

    found = [
        Collection(Source.PERTURBED, "expert", lambda s, n, _r: expert(s, n), seeds(20)),
        Collection(Source.PERTURBED, "expert_biased", biased_expert, seeds(12)),
        Collection(Source.PERTURBED, "expert_weak_grip", weak_grip_expert, seeds(12)),
    ]
    if weak_policy:

        def learned(simulator: MetaworldSimulator, name: str, _rng: np.random.Generator) -> Controller:
            return LearnedPolicy(simulator, PLATFORM.task(name), weak_policy)

        found.append(Collection(Source.NATURAL, WEAK_POLICY, learned, seeds(30)))
    return found


def collect(simulator: MetaworldSimulator, out: Path, kinds: Iterable[Collection]) -> None:
    """Rolls out: a row each in `rollouts.jsonl`, and the actions of the failures below `actions/`."""
    table = out / "rollouts.jsonl"
    done = {row["key"] for row in plain_records(table)}
    (out / "actions").mkdir(parents=True, exist_ok=True)
    for kind in kinds:
        for name in DEMO_TASKS:
            failed = 0
            for seed in kind.seeds:
                key = f"{name}-{kind.source.value}-{kind.policy}-{seed}"
                if key in done:
                    continue
                rng = np.random.default_rng([seed, len(kind.policy)])
                task, reset = PLATFORM.task(name), Reset(seed=seed)
                simulator.reset(task, reset)
                driven = record(
                    simulator,
                    task,
                    reset,
                    kind.make(simulator, name, rng),
                    steps=ROLLOUT_STEPS,
                    perturb=rng if kind.source is Source.PERTURBED else None,
                )
                solved = driven.solved[-1]
                if not solved:
                    np.save(out / "actions" / f"{key}.npy", driven.rollout.actions)
                    failed += 1
                row = {"key": key, "task": name, "seed": seed, "source": kind.source.value}
                append_records(table, {**row, "policy": kind.policy, "solved": solved})
            print(f"collect {kind.source.value} {kind.policy} {name}: {failed} new failures", flush=True)


def locate(simulator: MetaworldSimulator, out: Path) -> None:
    """Replays the failures and finds their recovery points and labels: a row each in `points.jsonl`."""
    table = out / "points.jsonl"
    done = {row["key"] for row in plain_records(table)}
    rollouts = plain_records(out / "rollouts.jsonl")
    todo = [row for row in rollouts if not row["solved"] and row["key"] not in done]
    for row in todo:
        actions = np.load(out / "actions" / f"{row['key']}.npy")
        simulator.reset(PLATFORM.task(row["task"]), Reset(seed=row["seed"]))
        replay, trace = watch(simulator, row["task"], actions.__getitem__)
        advance(simulator, map(replay, range(len(actions))))
        found = recovery_point(trace)
        label = {} if found is None else {"stage": found[1].value, "deviation": found[2].value}
        append_records(table, {**row, "step": None if found is None else found[0], **label})
    print(f"locate: {len(todo)} failures replayed", flush=True)


def prove(simulator: MetaworldSimulator, out: Path, limits: Limits = SHIPPED) -> None:
    """Finds out which candidates some controller solves from the recovery point, within the horizon.

    Only until each group of task, cell and source has enough.
    """
    table = out / "proofs.jsonl"
    proofs = {(row["key"], row["step"]): row["attempts"] for row in plain_records(table)}
    tried: Counter[tuple[str, ...]] = Counter()
    proven: Counter[tuple[str, ...]] = Counter()
    for row in plain_records(out / "points.jsonl"):
        if not row["step"]:
            continue
        group = (row["task"], row["stage"], row["deviation"], row["source"], row["policy"])
        if tried[group] >= limits.tried or proven[group] >= limits.proven:
            continue
        point = row["key"], row["step"]
        if point not in proofs:
            proofs[point] = attempts = _attempts(simulator, out, row)
            append_records(table, {"key": row["key"], "step": row["step"], "attempts": attempts})
            cell = f"{row['stage']}-{row['deviation']}"
            print(f"prove {row['key']} {cell} at {row['step']}: {attempts}", flush=True)
        tried[group] += 1
        proven[group] += any(proofs[point].values())


def _attempts(simulator: MetaworldSimulator, out: Path, row: dict[str, Any]) -> dict[str, int | None]:
    """Steps to success by controller, None where it failed; up to the first that succeeds."""
    name = row["task"]
    controllers: dict[str, Controller] = (
        {} if row["policy"] == "expert" else {"expert": expert(simulator, name)}
    )
    for seed in PROOF_SEEDS:
        rng = np.random.default_rng(seed)
        controllers[f"patient_expert/{seed}"] = patient_expert(simulator, name, rng)
    attempts: dict[str, int | None] = {}
    for label, act in controllers.items():
        simulator.reset(PLATFORM.task(name), Reset(seed=row["seed"]))
        advance(simulator, np.load(out / "actions" / f"{row['key']}.npy")[: row["step"]])
        if simulator.succeeded():
            break
        attempts[label] = _steps_to_success(simulator, act)
        if attempts[label] is not None:
            break
    return attempts


def _steps_to_success(simulator: MetaworldSimulator, act: Controller) -> int | None:
    for t in range(HORIZON):
        simulator.step(act(t))
        if simulator.succeeded():
            return t + 1
    return None


def select(out: Path, limits: Limits = SHIPPED) -> list[dict[str, Any]]:
    """Proven candidates that the review of the frames did not drop, spread over cells, tasks and sources.

    Rarer cells choose first; within a cell, the task and source with the fewest scenarios so far.
    """
    proofs = {(row["key"], row["step"]): row["attempts"] for row in plain_records(out / "proofs.jsonl")}
    pool = [
        {**row, "attempts": proofs[row["key"], row["step"]]}
        for row in plain_records(out / "points.jsonl")
        if row["step"]
        and row["key"] not in DROPPED
        and any(proofs.get((row["key"], row["step"]), {}).values())
    ]
    cells = Counter((r["stage"], r["deviation"]) for r in pool)
    chosen: list[dict[str, Any]] = []
    for cell, _ in sorted(cells.items(), key=lambda item: (item[1], item[0])):
        left = [r for r in pool if (r["stage"], r["deviation"]) == cell]
        taken: list[dict[str, Any]] = []
        while left and len(taken) < limits.per_cell:
            tasks, in_cell = Counter(r["task"] for r in chosen + taken), Counter(r["task"] for r in taken)
            policies = Counter((r["source"], r["policy"]) for r in chosen + taken)
            left = [
                r
                for r in left
                if tasks[r["task"]] < limits.per_task and in_cell[r["task"]] < limits.per_task_and_cell
            ]
            if not left:
                break
            best = min(
                left,
                key=lambda r: (
                    in_cell[r["task"]],
                    policies[r["source"], r["policy"]],
                    tasks[r["task"]],
                    r["key"],
                ),
            )
            taken.append(best)
            left.remove(best)
        chosen += taken
    return sorted(chosen, key=lambda r: r["key"])


def scenarios(
    simulator: MetaworldSimulator, out: Path, chosen: Iterable[dict[str, Any]], split: str = "test"
) -> Iterator[Scenario]:
    """The selected rows as scenarios with fingerprints."""
    for row in chosen:
        key, attempts = row["key"], row["attempts"]
        yield with_fingerprint(
            simulator,
            Scenario(
                id=key.replace("_", "-"),
                task=PLATFORM.task(row["task"]),
                reset=Reset(seed=row["seed"]),
                prefix=np.load(out / "actions" / f"{key}.npy")[: row["step"]],
                stage=row["stage"],
                deviation=row["deviation"],
                source=row["source"],
                source_policy=row["policy"],
                split=split,
                cluster=key,
                provenance={
                    "proof": {name: steps for name, steps in attempts.items() if steps is not None},
                    "failed_attempts": [name for name, steps in attempts.items() if steps is None],
                    "labels": "rules of recipes/metaworld/labels.py"
                    + ("; frames checked by one automated reviewer" if split == "test" else ""),
                },
            ),
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="working folder; kept between runs")
    parser.add_argument("--weak-policy", help="checkpoint of a weak learned policy, for natural failures")
    parser.add_argument("--sheets", action="store_true", help="draw the frames around each recovery point")
    parser.add_argument("--write", type=Path, help="write the selected scenarios to this dataset folder")
    parser.add_argument("--first-seed", type=int, default=0, help="of the rollouts; 0 is the shipped set's")
    parser.add_argument("--training", action="store_true", help="a larger set, as split train")
    parser.add_argument("--no-proof", action="store_true", help="stop once recovery points are located")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    simulator = MetaworldSimulator(obs_type="state")
    limits = TRAINING if args.training else SHIPPED
    if not (args.sheets or args.write):
        collect(simulator, args.out, collections(args.weak_policy, args.first_seed, limits))
        locate(simulator, args.out)
        if args.no_proof:
            return
        prove(simulator, args.out, limits)
    chosen = select(args.out, limits)
    for cell, count in sorted(Counter(f"{r['stage']}-{r['deviation']}" for r in chosen).items()):
        print(f"{cell}: {count}")
    if args.sheets:
        from recipes.metaworld.review import draw_sheets

        draw_sheets(args.out, chosen)
    if args.write:
        from lerobot_roborecover.datasets import write_scenarios

        write_scenarios(
            args.write,
            scenarios(simulator, args.out, chosen, "train" if args.training else "test"),
            description="Recovery scenarios of ten Meta-World tasks: perturbed scripted experts, and "
            "failures of a weak learned policy.",
            license="Apache-2.0",
        )
    simulator.close()


if __name__ == "__main__":
    main()
