"""Recoveries of Meta-World tasks as a LeRobotDataset, for a donor policy that recovers better than the
shipped one.

From the recovery points of a starter working folder (other seeds than any scenario's) the patient scripted
policy drives, which backs off and tries again; what it solves is kept, beside ordinary demonstrations.

    python -m recipes.metaworld.starter --out WORK --first-seed 20000 --no-proof
    python -m recipes.metaworld.recoveries --failures WORK --out DIR
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.metaworld import PLATFORM
from lerobot_roborecover.platforms.metaworld.experts import patient_expert
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.platforms.simulator import advance
from lerobot_roborecover.scenario import Reset
from lerobot_roborecover.utils.journal import plain_records
from recipes.metaworld.dataset import (
    DEMO_TASKS,
    Episode,
    create_dataset,
    record,
    save_demonstrations,
    save_episode,
)

_MAX_STEPS = 220
"""Two attempts."""


def recovery(
    simulator: MetaworldSimulator, row: dict[str, Any], prefix: np.ndarray, seed: int
) -> Episode | None:
    """A recovery; None where it failed.

    Args:
        simulator: with any `obs_type`.
        row: of the working folder's `points.jsonl`.
        prefix: (t, 4) actions up to the recovery point.
        seed: of the driver's jitter.
    """
    simulator.reset(PLATFORM.task(row["task"]), Reset(seed=row["seed"]))
    advance(simulator, prefix)
    act = patient_expert(simulator, row["task"], np.random.default_rng(seed))
    return record(simulator, act, _MAX_STEPS)


def recoveries(simulator: MetaworldSimulator, failures: Path) -> Iterator[tuple[str, Any]]:
    """Task name and episode of each recovery point: at the point itself, and some steps earlier."""
    rows = plain_records(failures / "points.jsonl")
    for row in rows:
        if not row["step"]:
            continue
        actions = np.load(failures / "actions" / f"{row['key']}.npy")
        for seed, earlier in enumerate((0, 15, 30)):
            yield row["task"], recovery(simulator, row, actions[: max(row["step"] - earlier, 0)], seed)


def write(root: Path, failures: Path, demonstrations_per_task: int) -> None:
    """Writes the dataset; `root` must not exist."""
    dataset = create_dataset(root)
    simulator = MetaworldSimulator(obs_type="state")
    kept = tried = 0
    for name, episode in recoveries(simulator, failures):
        tried += 1
        if episode is not None:
            save_episode(dataset, PLATFORM.task(name), episode)
            kept += 1
    print(f"{kept} recoveries from {tried} attempts", flush=True)
    for name in DEMO_TASKS:
        save_demonstrations(
            dataset, simulator, name, demonstrations_per_task, lambda k: 0 if k % 2 == 0 else 20 * (k % 7)
        )
    dataset.finalize()
    simulator.close()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--failures", type=Path, required=True, help="working folder of metaworld_starter")
    parser.add_argument("--out", type=Path, required=True, help="folder to write; must not exist")
    parser.add_argument("--demonstrations-per-task", type=int, default=30)
    args = parser.parse_args()
    write(args.out, args.failures, args.demonstrations_per_task)


if __name__ == "__main__":
    main()
