"""Measures how far a start is from its recovery point, and says whether it may be run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_roborecover.logs.robot import CameraError, StartError
from lerobot_roborecover.robot.connection import RobotError, asking, positions
from lerobot_roborecover.robot.points import PointSet, RobotPoint
from lerobot_roborecover.robot.reference import Reference
from lerobot_roborecover.robot.vision import compare

_LOOKS = 3
"""Observations that a measurement averages over, to be rid of noise and of pictures that are late."""


@dataclass(frozen=True)
class Tolerance:
    """How far off a start may be; set before a run, and part of its plan. 0 leaves a measure out."""

    joint: float = 3.0
    """Of any joint, in the robot's units."""
    background_px: float = 2.0
    """Of any camera that stands still."""
    object_px: float = 2.0
    """Of the objects."""
    similarity: float = 0.8
    """Least normalised correlation of the object region."""
    tag_mm: float = 0.0
    """Of any fiducial tag."""
    tag_side_mm: float = 0.0
    """Side of the tags; 0 looks for none."""
    moving_cameras: tuple[str, ...] = ("wrist",)
    """Cameras on the arm: their pictures are shown and measured, and decide nothing."""

    def problems(self, error: StartError) -> tuple[str, ...]:
        """What is outside, one line each, the most helpful first.

        Args:
            error: as measured.
        """
        found = [
            f"joint {n.removesuffix('.pos')} is {abs(v):.1f} off, at most {self.joint:g}"
            for n, v in error.joints.items()
            if self.joint and abs(v) > self.joint
        ]
        for name, camera in error.cameras.items():
            if name in self.moving_cameras:
                continue
            found += self._of_camera(name, camera)
        return tuple(found)

    def _of_camera(self, name: str, camera: CameraError) -> list[str]:
        found = []
        for value, limit, words in (
            (camera.background_px, self.background_px, "the camera has moved by {:.1f} px"),
            (camera.object_px, self.object_px, "objects are {:.1f} px off"),
            (camera.tag_mm, self.tag_mm, "a tag is {:.1f} mm off"),
        ):
            if limit and value is not None and value > limit:
                found.append(f"camera {name}: {words.format(value)}, at most {limit:g}")
        if self.similarity and camera.similarity is not None and camera.similarity < self.similarity:
            found.append(
                f"camera {name}: the objects look different ({camera.similarity:.2f}, at least "
                f"{self.similarity:g})"
            )
        return found


class StartCheck:
    """Compares a robot's present state with a recovery point.

    Args:
        points: the set that the point is of.
        point: the recovery point.
        tolerance: what may be run.
    """

    def __init__(self, points: PointSet, point: RobotPoint, tolerance: Tolerance):
        self.point, self.tolerance = point, tolerance
        self.references: dict[str, Reference] = {}
        self._table: dict[str, Any] = {}
        for camera, frames in points.pictures(point).items():
            reference = Reference.of(frames)
            drawn = [tuple(box) for box in point.boxes.get(camera, ())]
            self.references[camera] = reference.with_boxes(drawn) if drawn else reference

    def look(self, robot: Any) -> dict[str, Any]:
        """One observation; refuses pictures of another size.

        Raises:
            RobotError: a camera's pictures have another size than the recorded ones.
        """
        with asking(robot):
            observation = robot.get_observation()
        for camera, reference in self.references.items():
            if observation[camera].shape != reference.picture.shape:
                raise RobotError(
                    f"camera {camera!r} gives {observation[camera].shape}, the point has "
                    f"{reference.picture.shape}: set its width and height as they were in --robot.cameras"
                )
        return observation

    def see_table(self, robot: Any) -> None:
        """Looks at the cleared table before the arm moves to the point.

        Raises:
            RobotError: see `look`.
        """
        self._table = self._latest(robot)

    def see_cleared(self, robot: Any) -> None:
        """Looks at the cleared table with the arm at the point; after `see_table`.

        Raises:
            RobotError: see `look`.
        """
        live = self._latest(robot)
        self.references = {c: r.with_cleared(self._table[c], live[c]) for c, r in self.references.items()}

    def _latest(self, robot: Any) -> dict[str, Any]:
        """An observation without pictures that are late."""
        return [self.look(robot) for _ in range(_LOOKS)][-1]

    def measure(self, robot: Any) -> tuple[StartError, Mapping[str, np.ndarray]]:
        """The start error, and the live pictures that it was measured on.

        Raises:
            RobotError: see `look`.
        """
        looks = [self.look(robot) for _ in range(_LOOKS)]
        measured = [positions(robot, look) for look in looks]
        joints = {
            n: float(np.mean([m[n] for m in measured])) - self.point.joints[n] for n in self.point.joints
        }
        live = {camera: looks[-1][camera] for camera in self.references}
        cameras = {
            camera: replace(
                compare(reference, live[camera], self.tolerance.tag_side_mm or None),
                moving=camera in self.tolerance.moving_cameras,
            )
            for camera, reference in self.references.items()
        }
        error = StartError(joints, cameras)
        return replace(error, problems=self.tolerance.problems(error)), live
