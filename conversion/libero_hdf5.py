"""Converts LIBERO or robomimic demonstrations (HDF5) to a trajectory dataset of rollouts.

    python conversion/libero_hdf5.py TASK_demo.hdf5 ... --out DIR

What cannot be replayed exactly is marked so, episode by episode, with the reason: docs/publish.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.datasets.converted import each_source, write_converted
from lerobot_roborecover.datasets.episodes import to_frame
from lerobot_roborecover.datasets.hdf5 import episode_names, open_hdf5, read_array, read_group
from lerobot_roborecover.datasets.licenses import add_license
from lerobot_roborecover.datasets.trajectory_write import Frame, Trajectory
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.libero.init_states import read_init_states
from lerobot_roborecover.scenario import ScenarioError, Task

CAMERAS = (("agentview_rgb", "agentview_image"), ("eye_in_hand_rgb", "robot0_eye_in_hand_image"))
"""By LeRobot's `image` and `image2`: LIBERO's own names and robomimic's."""

NO_OBS = (
    "raw demonstrations have no observations. Render them with LIBERO's scripts/create_dataset.py, or "
    "robomimic's dataset_states_to_obs.py"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Converts; 0 done, 1 done but some episodes failed, 2 refused."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("files", nargs="+", type=Path, help="HDF5 files, one a task")
    parser.add_argument("--out", type=Path, required=True, help="new folder of the dataset")
    parser.add_argument("--suite", default="", help="where several suites have a task of the name")
    parser.add_argument(
        "--controller", "--driver", dest="driver", default="human", help="who acted (%(default)s)"
    )
    add_license(parser)
    args = parser.parse_args(argv)
    return write_converted(
        "libero_hdf5",
        args.out,
        lambda failed: each_source(
            args.files, lambda path: episodes(path, args.suite, args.driver, failed), failed
        ),
        fps=20,
        description="LIBERO demonstrations, converted.",
        license=args.license,
    )


def episodes(path: Path, suite: str, driver: str, failed: list[str]) -> Iterator[Trajectory]:
    """The demonstrations of one file; those that fail are described in `failed`."""
    with open_hdf5(path) as file:
        data = read_group(file, "data", "it is not a LIBERO or robomimic file")
        bddl = PurePosixPath(str(data.attrs.get("bddl_file_name", ""))).stem
        task = platform_named("libero").task(bddl or path.stem.removesuffix("_demo"), suite=suite)
        states = read_init_states(task.suite, task.name)
        for name in episode_names(data, "demo_"):
            try:
                yield trajectory(read_group(data, name), name, path, task, states, driver)
            except ScenarioError as err:
                failed.append(str(err))


def trajectory(demo: Any, name: str, path: Path, task: Task, states: np.ndarray, driver: str) -> Trajectory:
    """One demonstration."""
    actions = read_array(demo, "actions", ndim=2, width=7)
    reasons = ["fixture poses are not recorded"]
    if actions.dtype != np.float64:
        reasons.append(f"actions are {actions.dtype}")
    # The env pauses while a person reads the scene; a file without a single pause had them taken out.
    if not (np.abs(actions[:, :6]).max(axis=1) < 1e-6).any():
        reasons.append("no action is a no-op: they were probably taken out")
    rows = (len(actions), "actions")
    first = read_array(demo, "states", ndim=2, rows=rows)[0] if "states" in demo else None
    index = None
    if first is not None and first.shape == states[0].shape:
        # The first number is the simulator's clock.
        match = np.flatnonzero((states[:, 1:] == first[1:]).all(axis=1))
        index = int(match[0]) if len(match) else None
    if index is None:
        reasons.append("the first state is none of the task's stored init states")
    rewards = read_array(demo, "rewards", ndim=1, rows=rows) if "rewards" in demo else np.zeros(1)
    return Trajectory(
        task=task,
        driver=driver,
        actions=actions.astype(np.float64),
        frames=list(frames(read_group(demo, "obs", NO_OBS), len(actions))),
        success=bool(rewards[-1] > 0),
        not_replayable="; ".join(reasons),
        provenance={"file": path.name, "episode": name, "init_state_index": index},
    )


def frames(obs: Any, steps: int) -> Iterator[Frame]:
    """Observations under the names and in the form that policies of LeRobot's LIBERO env see."""
    pictures = {}
    rows = (steps, "actions")
    for key, names in zip(("image", "image2"), CAMERAS, strict=True):
        name = next((n for n in names if n in obs), None)
        if name is not None:
            pictures[key] = read_array(obs, name, ndim=4, width=3, rows=rows)
    if "ee_states" in obs:
        pose, gripper = (
            read_array(obs, "ee_states", ndim=2, width=6, rows=rows),
            read_array(obs, "gripper_states", ndim=2, width=2, rows=rows),
        )
        state = np.concatenate([pose, gripper], axis=1).astype(np.float32)
    else:
        state = None
        position, quat = (
            read_array(obs, "robot0_eef_pos", ndim=2, width=3, rows=rows),
            read_array(obs, "robot0_eef_quat", ndim=2, width=4, rows=rows),
        )
        gripper = read_array(obs, "robot0_gripper_qpos", ndim=2, width=2, rows=rows)
    for i in range(steps):
        robot = {
            "eef": {"pos": np.zeros(3), "quat": np.array([0.0, 0.0, 0.0, 1.0]), "mat": np.eye(3)},
            "gripper": {"qpos": gripper[i].astype(np.float64), "qvel": np.zeros(2)},
            "joints": {"pos": np.zeros(7), "vel": np.zeros(7)},
        }
        if state is None:
            robot["eef"] |= {"pos": position[i].astype(np.float64), "quat": quat[i].astype(np.float64)}
        frame = to_frame("libero", {"pixels": {k: v[i] for k, v in pictures.items()}, "robot_state": robot})
        if state is not None:
            frame["observation.state"] = state[i]
        yield frame


if __name__ == "__main__":
    sys.exit(guarded("libero_hdf5", main))
