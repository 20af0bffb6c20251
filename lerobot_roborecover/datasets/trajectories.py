"""Trajectory datasets: donors for Correction, labelled frames for the monitor, and rollouts to build from.

Each is an ordinary LeRobotDataset with LeRobot's own feature names of the platform, so that
`lerobot-train --dataset.repo_id=...` takes it as it is. Beside them are the exact float64 action, the row of
the frame's scenario, and `meta/roborecover/trajectories.json`: one entry a scenario and one an episode.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.files import load_json, read_bytes, what_it_is
from lerobot_roborecover.datasets.parquet_read import read_frames
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.scenario import Reset, ScenarioError, Task

TRAJECTORIES_FILE = "trajectories.json"
SCHEMA_VERSION = 1
KINDS = ("donors", "monitor", "rollouts", "training")
LABEL = "next.reward"
"""(1,) float32: the monitor's label of the frame. LeRobot hands this column, and no other of ours, to a
reward model."""
MAX_TRAJECTORIES_BYTES = 2**26


@dataclass(frozen=True)
class ScenarioLink:
    """A scenario that trajectories belong to."""

    id: str
    sha256: str
    """`Scenario.sha256()`: what decides its recovery state."""
    split: str


@dataclass(frozen=True)
class TrajectoryRow:
    """What is known of one episode."""

    task: dict[str, Any]
    """Platform, suite, name, instruction and horizon, as in `Task`."""
    driver: str
    """The policy, person or script that acted."""
    steps: int
    success: bool
    actions_sha256: str
    """Of the exact actions: identifies the episode after any dataset tool."""
    scenario_index: int = -1
    """Row among the scenarios; -1 where it belongs to none."""
    first_step: int = 0
    """Prefix actions of the scenario before the episode's first frame."""
    trial: int | None = None
    """Which of the driver's trials on the scenario."""
    reset: dict[str, Any] | None = None
    """What puts the task in the episode's exact first state, as in `Reset`, fixtures as name to position and
    quaternion; None where it is not known or is the scenario's."""
    not_replayable: str = ""
    """Why the episode cannot be replayed exactly; empty where it can."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """JSON-able notes: where it comes from."""

    def task_record(self) -> Task:
        """The task."""
        return Task(**self.task)

    def reset_record(self) -> Reset | None:
        """The reset, where it is known."""
        if self.reset is None:
            return None
        return Reset.of_json(self.reset)


@dataclass(frozen=True)
class TrajectorySet:
    """A trajectory dataset's own metadata."""

    root: Path
    kind: str
    platform: str
    scenarios: tuple[ScenarioLink, ...]
    rows: tuple[TrajectoryRow, ...]
    """Rows by episode."""
    manifest: Mapping[str, Any]

    def episodes(self, split: str) -> list[int]:
        """Episodes of the scenarios of one split, for `--dataset.episodes`.

        Raises:
            ScenarioError: no scenario is in that split.
        """
        found = [
            i
            for i, row in enumerate(self.rows)
            if row.scenario_index >= 0 and self.scenarios[row.scenario_index].split == split
        ]
        if not found:
            splits = sorted({s.split for s in self.scenarios})
            raise ScenarioError(f"{self.root} has no trajectories of split {split!r}; there are {splits}")
        return found

    def actions(self) -> list[np.ndarray]:
        """The exact (T, A) float64 actions of every episode; LeRobot's own reader rounds them to float32."""
        return [actions for actions, _ in read_exact(self.root)]


def read_trajectories(root: str | os.PathLike[str], *, videos: bool = True) -> TrajectorySet:
    """Reads and checks a trajectory dataset's own metadata; trusts nothing in it.

    Args:
        root: the dataset's folder.
        videos: refuse a dataset whose videos have another number of frames than steps; False reads the
            metadata alone.

    Raises:
        ScenarioError: names the file and the field.
    """
    root = Path(root)
    path = root / FOLDER / TRAJECTORIES_FILE
    data = read_bytes(root, path, MAX_TRAJECTORIES_BYTES)
    try:
        found = load_json(data)
        if found["schema_version"] > SCHEMA_VERSION:
            raise ScenarioError(
                f"{path}, field schema_version: {found['schema_version']} is from the future; upgrade this "
                "package: pip install -U lerobot_env_roborecover"
            )
        links = tuple(ScenarioLink(**s) for s in found["scenarios"])
        rows = tuple(TrajectoryRow(**r) for r in found["trajectories"])
        counts = found["counts"]
        kind, platform = found["kind"], found["platform"]
        for row in rows:
            row.task_record()
            row.reset_record()
    except ScenarioError as err:
        raise ScenarioError(f"{path}: {err}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        raise ScenarioError(
            f"{path} is not what write_trajectories writes ({err!r:.200}): {what_it_is(data)}"
        ) from None
    for number, row in enumerate(rows):
        _check_types(f"{path}: trajectory {number}", row)
    good = kind in KINDS and all(
        type(r.scenario_index) is int
        and -1 <= r.scenario_index < len(links)
        and r.task["platform"] == platform
        for r in rows
    )
    if not good or not rows or counts["trajectories"] != len(rows) or counts["scenarios"] != len(links):
        raise ScenarioError(
            f"{path}: kind, platform, scenario_index and counts do not agree with its {len(rows)} "
            f"trajectories and {len(links)} scenarios. Fetch or write the dataset again"
        )
    _check_leakage(path, links)
    if videos:
        check_frames(root, [row.steps for row in rows])
    return TrajectorySet(root, kind, platform, links, rows, found)


def _check_types(where: str, row: TrajectoryRow) -> None:
    wanted = {
        "driver": str, "steps": int, "success": bool, "actions_sha256": str, "first_step": int,
        "not_replayable": str, "provenance": dict,
    }  # fmt: skip
    for name, kind in wanted.items():
        value = getattr(row, name)
        if type(value) is not kind or (kind is int and value < 0):
            raise ScenarioError(f"{where}, field {name}: {value!r:.80} is not of type {kind.__name__}")


def _check_leakage(path: Path, links: Sequence[ScenarioLink]) -> None:
    for key in ("id", "sha256"):
        split_of: dict[str, str] = {}
        for link in links:
            if split_of.setdefault(getattr(link, key), link.split) != link.split:
                raise ScenarioError(
                    f"{path}: the scenario with {key} {getattr(link, key)!r:.80} is in two splits; frames of "
                    "a scenario stay together"
                )


def read_exact(root: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Exact (T, A) float64 actions and (T,) scenario rows of every episode, in the order of the episodes.

    Raises:
        ScenarioError: the data lacks our columns.
    """
    from lerobot_roborecover.datasets.episodes import EXACT_ACTION, SCENARIO_INDEX

    found = read_frames(root, (EXACT_ACTION, SCENARIO_INDEX))
    return [
        (
            found[number][EXACT_ACTION].astype(np.float64, copy=False),
            found[number][SCENARIO_INDEX][:, 0].astype(np.int64, copy=False),
        )
        for number in sorted(found)
    ]


def actions_sha256(actions: np.ndarray) -> str:
    """Hash of exact actions, (T, A) float64."""
    return hashlib.sha256(str(actions.shape).encode() + actions.astype("<f8").tobytes()).hexdigest()
