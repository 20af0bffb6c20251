"""Recovery points from recorded episodes: any LeRobotDataset of a robot with joint positions and cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.robot.points import CAMERA_PREFIX, MAX_APPROACH, make_point
from lerobot_roborecover.robot.recorder import RobotNotes, read_notes, truths
from lerobot_roborecover.scenario import Scenario, ScenarioError

MOMENTS = 8
"""Pictures of an episode that a point keeps, the recovery point's last: they tell background from objects."""
_APPROACH_S, _APPROACH_HZ = 6.0, 10.0


@dataclass(frozen=True)
class PointRequest:
    """A recovery point to be made of an episode."""

    episode: int
    frame: int
    stage: str
    deviation: str
    source: str = "natural"
    source_policy: str = ""
    quasi_static: bool = False
    boxes: Mapping[str, Sequence[Sequence[int]]] | None = None
    """Left, top, width and height of the objects by camera; None takes the lab's, or the foreground."""
    votes: Sequence[Mapping[str, Any]] = ()
    """Of several raters, for the provenance."""


class Episodes:
    """A LeRobotDataset of a robot.

    Args:
        root: its folder.
        notes: what is known of the robot where the dataset does not say it.

    Raises:
        ScenarioError: it cannot be read, or has neither joint positions nor pictures.
    """

    def __init__(self, root: Path, notes: RobotNotes | None = None):
        from lerobot.datasets import LeRobotDataset

        self.root = Path(root)
        if not (self.root / "meta" / "info.json").is_file():
            raise ScenarioError(f"{root} is no LeRobotDataset: meta/info.json is missing")
        try:
            self._dataset: Any = LeRobotDataset(f"local/{self.root.name}", root=self.root)
        except (OSError, ValueError, KeyError) as err:
            raise ScenarioError(f"{root} cannot be read: {' '.join(str(err).split())[:200]}") from None
        meta = self._dataset.meta
        features = meta.features
        names = features.get("observation.state", {}).get("names") or []
        self.cameras = [
            k.removeprefix(CAMERA_PREFIX) for k in meta.camera_keys if k.startswith(CAMERA_PREFIX)
        ]
        self._columns = [i for i, n in enumerate(names) if str(n).endswith(".pos")]
        self.joints = tuple(str(names[i]) for i in self._columns)
        if not self.joints or not self.cameras:
            raise ScenarioError(
                f"{root} has {len(self.joints)} joint positions (observation.state names that end in .pos) "
                f"and {len(self.cameras)} cameras; a recovery point needs both"
            )
        own = read_notes(self.root)
        self.notes = (
            own
            or notes
            or RobotNotes(str(meta.robot_type or "unknown"), "", self.joints, {}, float(meta.fps))
        )
        self.fps = float(meta.fps)
        self._starts = [int(e["dataset_from_index"]) for e in meta.episodes]
        self._ends = [int(e["dataset_to_index"]) for e in meta.episodes]

    def __len__(self) -> int:
        return len(self._starts)

    def steps(self, episode: int) -> int:
        """Frames of an episode.

        Raises:
            ScenarioError: there is no such episode.
        """
        if not 0 <= episode < len(self):
            raise ScenarioError(f"{self.root} has episodes 0 to {len(self) - 1}, not {episode}")
        return self._ends[episode] - self._starts[episode]

    def columns(self, episode: int, name: str) -> np.ndarray:
        """(T, D) float64 of an episode's `observation.state` or `action`."""
        self.steps(episode)
        rows = self._dataset.hf_dataset.with_format("numpy")[self._starts[episode] : self._ends[episode]]
        return np.stack(list(rows[name])).astype(np.float64)

    def pictures(self, episode: int, frames: Sequence[int]) -> dict[str, np.ndarray]:
        """(K, H, W, 3) uint8 by camera."""
        items = [self._dataset[self._starts[episode] + frame] for frame in frames]
        return {
            camera: np.stack(
                [
                    (item[CAMERA_PREFIX + camera].numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)
                    for item in items
                ]
            )
            for camera in self.cameras
        }

    def instruction(self, episode: int) -> str:
        """What the policy was told."""
        return str(self._dataset[self._starts[episode]]["task"])

    def point(self, request: PointRequest, time_limit_s: float) -> tuple[Scenario, dict[str, np.ndarray]]:
        """A recovery point and its pictures.

        Args:
            request: which frame, and its labels.
            time_limit_s: of a trial.

        Raises:
            ScenarioError: the frame is outside the episode, or a label is none.
        """
        episode, frame = request.episode, request.frame
        steps = self.steps(episode)
        if not 0 < frame < steps:
            raise ScenarioError(
                f"episode {episode}: frame {frame} is not from 1 to {steps - 1}, the frames of the episode"
            )
        states = self.columns(episode, "observation.state")[:, self._columns]
        stride = max(round(self.fps / _APPROACH_HZ), 1)
        first = max(frame - round(_APPROACH_S * self.fps), 0)
        kept = np.arange(frame, first - 1, -stride)[::-1][-MAX_APPROACH:]
        moments = sorted({round(f) for f in np.linspace(0, frame, MOMENTS)})
        pictures = self.pictures(episode, moments)
        instruction = self.instruction(episode)
        truth = dict(truths(self.root, episode)[frame]) if truths(self.root, episode) else {}
        boxes = request.boxes if request.boxes is not None else truth.pop("boxes", {})
        scenario = make_point(
            id=f"{plain_name(self.root.name)}-e{episode:04d}-f{frame:05d}",
            task_name=plain_name(instruction)[:80],
            instruction=instruction,
            actions=self.columns(episode, "action")[:frame],
            labels={
                "stage": request.stage,
                "deviation": request.deviation,
                "source": request.source,
                "source_policy": request.source_policy,
                "cluster": f"{plain_name(self.root.name)}-e{episode:04d}",
            },
            robot_type=self.notes.robot_type,
            calibration_sha256=self.notes.calibration_sha256,
            joints=dict(zip(self.joints, states[frame].round(5).tolist(), strict=True)),
            units=dict(self.notes.units),
            pictures={camera: stack[-1] for camera, stack in pictures.items()},
            fps=self.fps,
            time_limit_s=time_limit_s,
            approach=states[kept],
            dataset=self.root.name,
            episode=episode,
            quasi_static=request.quasi_static,
            truth=truth,
            boxes={camera: [list(b) for b in found] for camera, found in boxes.items()},
            provenance={"annotation": {"votes": [dict(v) for v in request.votes]}} if request.votes else {},
        )
        return scenario, pictures


def plain_name(text: str) -> str:
    """A text as part of an id."""
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-") or "point"
