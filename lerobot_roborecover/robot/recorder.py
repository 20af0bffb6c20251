"""Records a robot's episodes in a LeRobotDataset that is whole after each of them.

LeRobot closes a dataset's files at the end of a session; what a crash interrupts is lost. Here the files are
closed after every episode and the dataset is resumed for the next one. Beside LeRobot's own files,
`meta/roborecover/` says whose robot it was (`robot.json`) and where something was marked that went wrong
(`marks.jsonl`). A run's dataset says of each frame how its trial ended (`trial_columns`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.robot.connection import calibration_sha256, joint_names, joint_units
from lerobot_roborecover.robot.trial_columns import write_columns
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.journal import append_records, plain_records

ROBOT_FILE, MARKS_FILE, TRUTH_FILE = "robot.json", "marks.jsonl", "lab_truth.jsonl"
INTERVENTION = "intervention"
SCHEMA_VERSION = 1
OPERATOR, DETECTOR = "operator", "detector"
"""Who has marked a moment: a person, or a detector that suggests it."""


@dataclass(frozen=True)
class RobotNotes:
    """What a recorded dataset says of its robot."""

    robot_type: str
    calibration_sha256: str
    joints: tuple[str, ...]
    units: Mapping[str, str]
    fps: float


def notes_of(robot: Any, fps: float) -> RobotNotes:
    units = joint_units(robot)
    return RobotNotes(robot.name, calibration_sha256(robot), joint_names(robot), units, float(fps))


def read_notes(root: Path) -> RobotNotes | None:
    """What a dataset says of its robot; None where it was not recorded here.

    Raises:
        ScenarioError: the file is damaged.
    """
    path = root / FOLDER / ROBOT_FILE
    try:
        found = json.loads(path.read_text("utf-8"))
        if found["schema_version"] > SCHEMA_VERSION:
            raise ScenarioError(f"{path} is from the future; upgrade this package")
        return RobotNotes(
            str(found["robot_type"]),
            str(found["calibration_sha256"]),
            tuple(map(str, found["joints"])),
            {str(k): str(v) for k, v in found["units"].items()},
            float(found["fps"]),
        )
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError, AttributeError) as err:
        if isinstance(err, ScenarioError):
            raise
        raise ScenarioError(f"{path} is not what the recorder writes ({err!r:.80}); record again") from None


def marks(root: Path) -> list[dict[str, Any]]:
    """Where something went wrong, as people or a detector have marked it: `episode`, `frame`, `by`."""
    return plain_records(root / FOLDER / MARKS_FILE)


def truths(root: Path, episode: int) -> list[dict[str, Any]]:
    """The simulated lab's own state at each frame of an episode; none of a real robot."""
    for record in plain_records(root / FOLDER / TRUTH_FILE):
        if record["episode"] == episode:
            return record["frames"]
    return []


class Recorder:
    """Writes episodes of one robot.

    Args:
        root: the dataset's folder; made with the first episode, and extended where it is there.
        name: of the dataset, as LeRobot's rollout datasets are called.
        robot: connected.
        features: LeRobot's features of observation and action.
        fps: frames a second.
        columns: further features, whose values `begin` takes.

    Raises:
        ScenarioError: the folder holds the episodes of another robot or of another rate.
    """

    def __init__(
        self,
        root: Path,
        name: str,
        robot: Any,
        features: Mapping[str, Any],
        fps: float,
        columns: Mapping[str, Any] | None = None,
    ):
        self.root, self._name, self._robot, self._fps = root, name, robot, round(fps)
        intervention = {"dtype": "bool", "shape": (1,), "names": None}
        self._features = {**features, INTERVENTION: intervention, **(columns or {})}
        self._values: Mapping[str, Any] = {}
        self._notes = notes_of(robot, fps)
        self._dataset: Any = None
        self._truth: list[dict[str, Any]] = []
        self._seen: dict[str, Any] | None = None
        self._frames = 0
        before = read_notes(root)
        if before is not None and before != self._notes:
            raise ScenarioError(
                f"{root} holds episodes of {before.robot_type} at {before.fps:g} Hz with calibration "
                f"{before.calibration_sha256[:12] or 'none'}; this is {self._notes.robot_type} at {fps:g} Hz "
                f"with {self._notes.calibration_sha256[:12] or 'none'}. Name another folder"
            )

    def __len__(self) -> int:
        return self._frames

    @property
    def number(self) -> int:
        """Of the present or next episode."""
        if self._dataset is not None:
            return int(self._dataset.num_episodes)
        path = self.root / "meta" / "info.json"
        return int(json.loads(path.read_text("utf-8"))["total_episodes"]) if path.is_file() else 0

    def begin(self, values: Mapping[str, Any] | None = None) -> None:
        """Begins an episode; files are opened with its first frame, so that an empty one leaves none.

        Args:
            values: of the further columns, the same in all frames.
        """
        self._frames, self._truth, self._seen = 0, [], None
        self._values = values or {}

    def observed(self) -> None:
        """Keeps the simulated lab's own state for the frame whose observation was just taken: once the action
        is sent, objects are elsewhere."""
        if hasattr(self._robot, "hidden_truth"):
            self._seen = self._robot.hidden_truth()

    def _open(self) -> None:
        from lerobot.datasets import LeRobotDataset

        repo_id = f"local/{self._name}"
        if (self.root / "meta" / "info.json").is_file():
            self._dataset = LeRobotDataset.resume(repo_id, root=self.root, streaming_encoding=True)
        else:
            self._dataset = LeRobotDataset.create(
                repo_id,
                self._fps,
                root=self.root,
                robot_type=self._robot.name,
                features=self._features,
                streaming_encoding=True,
            )
        path = self.root / FOLDER / ROBOT_FILE
        if not path.is_file():
            values = {**self._notes.__dict__, "schema_version": SCHEMA_VERSION}
            path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write(path, json.dumps(values, indent=1) + "\n")

    def add(self, frame: Mapping[str, Any], task: str, intervention: bool) -> None:
        """Adds a frame: observation and the action that followed it."""
        if self._dataset is None:
            self._open()
        known = self._dataset.meta.features  # a dataset of an earlier version lacks columns
        values = {n: _as_feature(v) for n, v in self._values.items() if n in known}
        self._dataset.add_frame({**frame, **values, INTERVENTION: np.array([intervention]), "task": task})
        if self._seen is not None:
            self._truth.append(self._seen)
        self._frames += 1

    def save(self) -> int | None:
        """Ends the episode; it is on disk when this returns.

        Returns:
            Its number; None where it has no frames.
        """
        if self._dataset is None:
            return None
        number = self.number
        self._dataset.save_episode()
        self._dataset.finalize()
        self._dataset = None
        if self._values:
            write_columns(self.root, {number: self._values})
        if self._truth:
            append_records(self.root / FOLDER / TRUTH_FILE, {"episode": number, "frames": self._truth})
        return number

    def mark(self, episode: int, frame: int, by: str) -> None:
        """Notes that something went wrong at a frame."""
        append_records(self.root / FOLDER / MARKS_FILE, {"episode": episode, "frame": frame, "by": by})


def _as_feature(value: Any) -> Any:
    """A value as LeRobot records it; NaN is set only after the dataset's statistics are made."""
    return value if isinstance(value, str) else np.array([np.nan_to_num(value)], np.float32)
