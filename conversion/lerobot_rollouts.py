"""Makes a trajectory dataset of rollouts from a LeRobotDataset, e.g. of `lerobot-eval --eval.recording=true`.

    python conversion/lerobot_rollouts.py DATASET_FOLDER --platform libero --controller pi05 --out DIR

Videos are copied, not encoded again. What cannot be replayed exactly is marked so: docs/publish.md.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.datasets.converted import say
from lerobot_roborecover.datasets.episodes import EXACT_ACTION, SCENARIO_INDEX
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id, open_lerobot_folder
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.datasets.trajectories import TrajectoryRow, actions_sha256
from lerobot_roborecover.datasets.trajectory_write import write_metadata
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.platforms import SimulatorError, platform_named
from lerobot_roborecover.scenario import ScenarioError, Task
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_new


def main(argv: Sequence[str] | None = None) -> int:
    """Converts; 0 done, 2 refused."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    add = parser.add_argument
    add("dataset", type=Path, help="folder of a LeRobotDataset (v3.0)")
    add("--out", type=Path, required=True, help="new folder of the dataset")
    add("--platform", required=True, choices=("libero", "metaworld", "robotwin"))
    add("--controller", "--driver", dest="driver", required=True, help="the policy that acted")
    add("--task", help="the task's name, where the recorded instruction does not tell it")
    add("--suite", default="", help="where several suites have the task")
    add(
        "--license",
        type=license_argument,
        help="licence by the Hub's identifier, of the data; none is assumed",
    )
    args = parser.parse_args(argv)
    try:
        rows = convert(args)
    except (ScenarioError, SimulatorError) as err:
        print(f"lerobot_rollouts: {err}", file=sys.stderr)
        return 2
    say(args.out, rows)
    return 0


def convert(args: argparse.Namespace) -> list[TrajectoryRow]:
    """Copies the dataset with our columns added."""
    check_new(args.out)
    source = open_lerobot_folder(args.dataset)
    check_frames(args.dataset, thorough=True)
    from lerobot.datasets.dataset_tools import add_features

    rows, actions = read_rows(source, args)
    added = {
        EXACT_ACTION: (actions, {"dtype": "float64", "shape": (actions.shape[1],), "names": None}),
        SCENARIO_INDEX: (
            np.full(len(actions), -1, dtype=np.int64),
            {"dtype": "int64", "shape": (1,), "names": None},
        ),
    }
    with atomic_dir(args.out) as folder:
        add_features(source, added, output_dir=folder, repo_id=local_repo_id(args.out))
        write_metadata(
            folder, "rollouts", [], rows, description="Recorded rollouts, converted.", license=args.license
        )
    return rows


def read_rows(source: Any, args: argparse.Namespace) -> tuple[list[TrajectoryRow], np.ndarray]:
    """One row an episode, and the actions of all frames, (N, A) float64."""
    features = source.features
    if EXACT_ACTION in features:
        raise ScenarioError(
            f"{args.dataset} has a column {EXACT_ACTION} already: it is a dataset of this package"
        )
    if "action" not in features:
        others = sorted(n for n in features if not n.startswith("observation"))
        raise ScenarioError(
            f"{args.dataset} has no column action, only {others}. Rename the one that holds the actions, in "
            "meta/info.json, data/*/*.parquet and meta/stats.json"
        )
    shape = list(features["action"]["shape"])
    if len(shape) != 1 or shape[0] not in platform_named(args.platform).action_widths:
        raise ScenarioError(
            f"{args.dataset}: actions have width {', '.join(map(str, shape))}; {args.platform} takes "
            f"{' or '.join(map(str, platform_named(args.platform).action_widths))}"
        )
    names = ["action", "episode_index", "task_index", *(n for n in ("next.success",) if n in features)]
    table = source.hf_dataset.with_format("arrow").select_columns(names)[:]
    try:
        actions = np.array(table["action"].to_pylist(), dtype=np.float64).reshape(-1, shape[0])
    except (TypeError, ValueError):
        raise ScenarioError(
            f"{args.dataset}: column action is not {shape[0]} numbers in every frame. Record it again"
        ) from None
    if not np.isfinite(actions).all():
        raise ScenarioError(
            f"{args.dataset}: row {np.argwhere(~np.isfinite(actions))[0][0]}, action is not finite"
        )
    episode = np.array(table["episode_index"].to_pylist())
    tasks = [str(name) for name in source.meta.tasks.index]
    task_index = np.array(table["task_index"].to_pylist())
    success = np.array(table["next.success"].to_pylist()).reshape(-1) if "next.success" in features else None
    reason = why_not(args.dataset, features, success is not None)
    rows = []
    for number in range(source.num_episodes):
        mine = np.flatnonzero(episode == number)
        task = find_task(args, tasks[task_index[mine[0]]])
        provenance = {
            "dataset": args.dataset.name,
            "episode": number,
            "success_recorded": success is not None,
        }
        rows.append(
            TrajectoryRow(
                task=asdict(task),
                driver=args.driver,
                steps=len(mine),
                success=bool(success is not None and success[mine].any()),
                actions_sha256=actions_sha256(actions[mine]),
                not_replayable=reason,
                provenance=provenance,
            )
        )
    return rows, actions


def why_not(path: Path, features: dict[str, Any], recorded_by_eval: bool) -> str:
    """Why episodes of a plain LeRobotDataset cannot be replayed exactly."""
    reasons = ["the recording does not name its reset (seed or init state)"]
    # lerobot-eval hands the simulator the very float32 numbers that it records.
    if features["action"]["dtype"] != "float64" and not recorded_by_eval:
        reasons.append(f"actions are {features['action']['dtype']}")
    if re.search(r"no[-_]?noops?|no[-_]no[-_]?ops?", path.resolve().name, re.IGNORECASE):
        reasons.append("its name says that no-ops were taken out")
    return "; ".join(reasons)


def find_task(args: argparse.Namespace, instruction: str) -> Task:
    """The task of an episode."""
    if args.task:
        return platform_named(args.platform).task(args.task, instruction, args.suite)
    return platform_named(args.platform).task_by_instruction(instruction, args.suite)


if __name__ == "__main__":
    sys.exit(guarded("lerobot_rollouts", main))
