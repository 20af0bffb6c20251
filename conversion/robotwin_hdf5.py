"""Converts RoboTwin's saved episodes (HDF5) to a trajectory dataset of rollouts.

    python conversion/robotwin_hdf5.py DATA/TASK/demo_clean ... --out DIR

Saved episodes hold joint states, not the commanded actions: they train policies but cannot be replayed
exactly, and are marked so. RoboTwin's writer is
envs/utils/pkl2hdf5.py of https://github.com/RoboTwin-Platform/RoboTwin.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lerobot_roborecover.cli.output import guarded
from lerobot_roborecover.datasets.converted import each_source, write_converted
from lerobot_roborecover.datasets.hdf5 import open_hdf5, read_array, read_group
from lerobot_roborecover.datasets.licenses import add_license
from lerobot_roborecover.datasets.release.tables import read_file
from lerobot_roborecover.datasets.trajectory_write import Frame, Trajectory
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError

CAMERAS = ("head_camera", "left_camera", "right_camera")
"""As in LeRobot's RoboTwin env."""
MAX_JSON_BYTES = 2**24
WHY_NOT = "joint states sampled while the planner drove are not the commanded actions"


def main(argv: Sequence[str] | None = None) -> int:
    """Converts; 0 done, 1 done but some episodes failed, 2 refused."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "folders", nargs="+", type=Path, help="TASK/CONFIG folders that hold data/episode*.hdf5"
    )
    parser.add_argument("--out", type=Path, required=True, help="new folder of the dataset")
    parser.add_argument("--instruction-type", default="unseen", choices=("seen", "unseen"))
    parser.add_argument(
        "--fps", type=int, default=25, help="frame rate, as LeRobot's env has it (%(default)s)"
    )
    add_license(parser)
    args = parser.parse_args(argv)
    return write_converted(
        "robotwin_hdf5",
        args.out,
        lambda failed: each_source(
            args.folders, lambda folder: episodes(folder, args.instruction_type, failed), failed
        ),
        fps=args.fps,
        description="RoboTwin's saved episodes, converted; action is the next joint state.",
        license=args.license,
    )


def episodes(folder: Path, kind: str, failed: list[str]) -> Iterator[Trajectory]:
    """The episodes of one task and config; those that fail are described in `failed`."""
    paths = sorted((folder / "data").glob("episode*.hdf5"), key=lambda p: (len(p.stem), p.stem))
    if not paths:
        raise ScenarioError(
            f"{folder} has no data/episode*.hdf5; name a TASK/CONFIG folder of RoboTwin's data"
        )
    for path in paths:
        try:
            number = int(path.stem.removeprefix("episode"))
            said = instruction(folder, number, kind)
            where = folder.resolve()
            task = platform_named("robotwin").task(where.parent.name, said, where.name)
            with open_hdf5(path) as file:
                joints = read_array(file, "joint_action/vector", ndim=2, width=14).astype(np.float64)
                if len(joints) < 2:
                    raise ScenarioError(
                        f"{path}: joint_action/vector has {len(joints)} states; two are needed"
                    )
                yield Trajectory(
                    task=task,
                    driver="expert",
                    actions=joints[1:],
                    frames=list(frames(file, joints)),
                    success=True,
                    not_replayable=WHY_NOT,
                    provenance={
                        "file": path.name,
                        "config": folder.name,
                        "seed": seed_of(folder, number),
                    },
                )
        except (ScenarioError, ValueError, RecursionError) as err:
            failed.append(f"{path}: {err}")


def seed_of(folder: Path, number: int) -> int | None:
    """An episode's seed, where it is recorded."""
    if not (folder / "seed.txt").is_file():
        return None
    words = read_file(folder, PurePosixPath("seed.txt"), MAX_JSON_BYTES).decode(errors="replace").split()
    if number >= len(words):
        return None
    try:
        return int(words[number])
    except ValueError:
        raise ScenarioError(
            f"seed.txt: {words[number]!r:.80} is not a whole number; it holds one an episode, as UTF-8"
        ) from None


def instruction(folder: Path, number: int, kind: str) -> str:
    """An episode's first instruction of a kind."""
    name = PurePosixPath(f"instructions/episode{number}.json")
    found = json.loads(read_file(folder, name, MAX_JSON_BYTES))
    said = found.get(kind) if isinstance(found, dict) else None
    if not isinstance(said, list) or not said or not isinstance(said[0], str):
        raise ScenarioError(f"{name}, field {kind}: {said!r:.80} is not a list of instructions")
    return said[0]


def frames(file: Any, joints: np.ndarray) -> Iterator[Frame]:
    """Observations under the names of LeRobot's RoboTwin env; the last state has no action, and no frame."""
    observation = read_group(file, "observation")
    pictures = {
        c: read_array(observation, f"{c}/rgb", ndim=1, rows=(len(joints), "joint states"))
        for c in CAMERAS
        if c in observation
    }
    for i in range(len(joints) - 1):
        yield {
            **{f"observation.images.{c}": decode(p[i]) for c, p in pictures.items()},
            "observation.state": joints[i].astype(np.float32),
        }


def decode(jpeg: bytes) -> np.ndarray:
    """(H, W, 3) uint8 RGB. RoboTwin hands RGB to an encoder that expects BGR, so that red and blue change
    places."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(jpeg), formats=["JPEG"]) as image:
            if max(image.size) > 4096:
                raise ScenarioError(f"a picture of {image.size} pixels; the limit is 4096 a side")
            return np.ascontiguousarray(np.asarray(image.convert("RGB"))[..., ::-1])
    except (UnidentifiedImageError, OSError) as err:
        raise ScenarioError(f"a camera picture is not a JPEG: {err}") from None


if __name__ == "__main__":
    sys.exit(guarded("robotwin_hdf5", main))
