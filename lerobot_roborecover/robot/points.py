"""Recovery points of real episodes, as scenarios of platform `robot`.

A point is a `Scenario`: the task, the actions up to the recovery point, labels. What puts a robot back is in
its reset's options, so that its hash covers it: robot type, calibration, joint positions, and a hash of each
camera's picture. The pictures are the dataset's last frames (`datasets/frame_files.py`). The recorded
approach and the point's origin are in the provenance. A robot has no simulator, so there is no fingerprint.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import LastFrames, encode_png
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task

PLATFORM = "robot"
KEY = "robot"
"""Of the reset's options and of the provenance."""
CAMERA_PREFIX = "observation.images."
MAX_JOINTS = 64
MAX_APPROACH = 200
MAX_TIME_LIMIT_S = 3600.0
_AGAIN = "Make the points again: roborecover robot points"


@dataclass(frozen=True)
class RobotPoint:
    """A recovery point with what puts a robot back to it."""

    scenario: Scenario
    robot_type: str
    """LeRobot's name of the robot."""
    calibration_sha256: str
    """Of the robot that recorded; empty where that is not known, or the robot has no calibration."""
    joints: Mapping[str, float]
    """Position by feature name, e.g. `shoulder_pan.pos`, in the robot's units."""
    units: Mapping[str, str]
    """Units by joint: `deg`, `percent`, `m`, or empty where it is not known."""
    pictures: Mapping[str, str]
    """SHA-256 of the recorded pixels by camera name."""
    fps: float
    time_limit_s: float
    approach: np.ndarray
    """(N, J) float64: joint positions on the way to the point, oldest first, the point's own last; columns as
    `joints`."""
    dataset: str
    """Where the episode was recorded: a Hub id, or a folder's name."""
    episode: int
    frame: int
    quasi_static: bool
    """People have said that nothing was falling, sliding, or held by friction alone."""
    boxes: Mapping[str, Any] = field(default_factory=dict)
    """Left, top, width and height of the objects by camera, as people have drawn them."""
    truth: Mapping[str, Any] = field(default_factory=dict)
    """The simulated lab's own state at the point, for its operator alone; empty on a real robot."""

    @property
    def id(self) -> str:
        return self.scenario.id

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.pictures)


def make_point(
    *,
    id: str,
    task_name: str,
    instruction: str,
    actions: np.ndarray,
    labels: Mapping[str, Any],
    robot_type: str,
    calibration_sha256: str,
    joints: Mapping[str, float],
    units: Mapping[str, str],
    pictures: Mapping[str, np.ndarray],
    fps: float,
    time_limit_s: float,
    approach: np.ndarray,
    dataset: str,
    episode: int,
    quasi_static: bool,
    truth: Mapping[str, Any] | None = None,
    boxes: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Scenario:
    """The scenario of a recovery point.

    Args:
        id: unique in its set.
        task_name: a plain name.
        instruction: as the policy gets it.
        actions: (t, A) float64, recorded up to the point.
        labels: `stage`, `deviation`, `source`, and optionally `source_policy`, `split`, `cluster`.
        robot_type: LeRobot's name.
        calibration_sha256: of the robot.
        joints: position by feature name.
        units: by joint.
        pictures: (H, W, 3) uint8 by camera name, at the point.
        fps: control steps a second.
        time_limit_s: a trial may take.
        approach: (N, J), see `RobotPoint`.
        dataset: of the episode.
        episode: its number.
        quasi_static: whether everything was at rest.
        truth: of the simulated lab.
        boxes: left, top, width and height of the objects by camera, as people have drawn them.
        provenance: further notes.

    Raises:
        ScenarioError: a value cannot be used; says which.
    """
    if not 0 < time_limit_s <= MAX_TIME_LIMIT_S:
        raise ScenarioError(
            f"point {id}: time limit {time_limit_s} s is not from 0 to {MAX_TIME_LIMIT_S:g} s"
        )
    start = {
        "robot_type": robot_type,
        "calibration_sha256": calibration_sha256,
        "joints": [[n, round(float(v), 6)] for n, v in joints.items()],  # JSON objects are sorted
        "pictures": {n: pixels_sha256(p) for n, p in pictures.items()},
        "fps": float(fps),
        "time_limit_s": float(time_limit_s),
    }
    notes = {
        "dataset": dataset,
        "episode": int(episode),
        "frame": len(actions),
        "units": dict(units),
        "quasi_static": bool(quasi_static),
        "approach": np.round(np.asarray(approach, np.float64), 5).tolist(),
        **({"truth": dict(truth)} if truth else {}),
        **({"boxes": dict(boxes)} if boxes else {}),
    }
    scenario = Scenario(
        id=id,
        task=Task(PLATFORM, robot_type, task_name, instruction, max(math.ceil(time_limit_s * fps - 1e-9), 1)),
        reset=Reset(options={KEY: start}),
        prefix=np.asarray(actions, np.float64),
        provenance={**(provenance or {}), KEY: notes},
        **labels,
    )
    point_of(scenario)
    return scenario


def point_of(scenario: Scenario) -> RobotPoint:
    """What puts a robot back, of a scenario of platform `robot`.

    Raises:
        ScenarioError: names the point, the field and the value.
    """
    try:
        return _parse(scenario)
    except ScenarioError as err:
        raise ScenarioError(f"point {scenario.id}: {err}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise ScenarioError(
            f"point {scenario.id}: not what `roborecover robot points` writes ({err!r:.120}). {_AGAIN}"
        ) from None


def _parse(scenario: Scenario) -> RobotPoint:
    if scenario.platform != PLATFORM:
        raise ScenarioError(
            f"platform is {scenario.platform!r}, not {PLATFORM!r}: this scenario is of a simulator. Run it "
            "with `roborecover eval`"
        )
    start, notes = scenario.reset.options[KEY], scenario.provenance[KEY]
    joints = {str(n): float(v) for n, v in start["joints"]}
    if not 1 <= len(joints) <= MAX_JOINTS or not np.isfinite(list(joints.values())).all():
        raise ScenarioError(f"field joints: {len(joints)} joints, not 1 to {MAX_JOINTS} finite positions")
    approach = np.asarray(notes["approach"], np.float64)
    if approach.ndim != 2 or approach.shape[1] != len(joints) or not 1 <= len(approach) <= MAX_APPROACH:
        raise ScenarioError(
            f"field approach: shape {approach.shape}, not (1 to {MAX_APPROACH}, {len(joints)} joints)"
        )
    if not np.isfinite(approach).all() or not np.allclose(approach[-1], list(joints.values()), atol=1e-3):
        raise ScenarioError("field approach: its last position is not the point's own joints")
    fps, limit = float(start["fps"]), float(start["time_limit_s"])
    if not 0 < fps <= 1000 or not 0 < limit <= MAX_TIME_LIMIT_S:
        raise ScenarioError(f"fields fps and time_limit_s: {fps} Hz and {limit} s cannot be used")
    if type(notes["quasi_static"]) is not bool:
        raise ScenarioError(f"field quasi_static: {notes['quasi_static']!r:.40} is not true or false")
    return RobotPoint(
        scenario=scenario,
        robot_type=str(start["robot_type"]),
        calibration_sha256=str(start["calibration_sha256"]),
        joints=joints,
        units={n: str(notes["units"].get(n, "")) for n in joints},
        pictures={str(n): str(h) for n, h in start["pictures"].items()},
        fps=fps,
        time_limit_s=limit,
        approach=approach,
        dataset=str(notes["dataset"]),
        episode=int(notes["episode"]),
        frame=int(notes["frame"]),
        quasi_static=notes["quasi_static"],
        boxes={str(c): [[int(v) for v in box] for box in b] for c, b in notes.get("boxes", {}).items()},
        truth=dict(notes.get("truth", {})),
    )


@dataclass(frozen=True)
class PointSet:
    """A set of recovery points as it was read."""

    root: Path
    points: tuple[RobotPoint, ...]
    frames: FrameStore

    def pictures(self, point: RobotPoint) -> dict[str, np.ndarray]:
        """(K, H, W, 3) uint8 by camera name: moments of the episode, the recovery point last.

        Raises:
            ScenarioError: a picture is missing, or is not the one that was recorded.
        """
        found = {n.removeprefix(CAMERA_PREFIX): p for n, p in self.frames.of(point.scenario).arrays().items()}
        for camera, sha256 in point.pictures.items():
            if camera not in found or pixels_sha256(found[camera][-1]) != sha256:
                raise ScenarioError(
                    f"{self.root}: the picture of camera {camera!r} at point {point.id} is not the one that "
                    f"was recorded. {_AGAIN}"
                )
        return {camera: found[camera] for camera in point.pictures}


def read_points(root: str | os.PathLike[str], select: Sequence[str] = ()) -> PointSet:
    """Reads a set of recovery points and checks each.

    Args:
        root: the set's folder.
        select: ids to keep; none keeps all.

    Raises:
        ScenarioError: it cannot be read, a point cannot be used, or an id is unknown.
    """
    points = tuple(point_of(s) for s in read_scenarios(root))
    known = {p.id for p in points}
    if unknown := [name for name in select if name not in known]:
        raise ScenarioError(f"{root} has no point {unknown[0]!r:.80}; it has {', '.join(sorted(known)):.500}")
    kept = tuple(p for p in points if not select or p.id in select)
    return PointSet(Path(root), kept, FrameStore(Path(root)))


def write_points(
    root: str | os.PathLike[str],
    scenarios: Sequence[Scenario],
    pictures: Mapping[str, Mapping[str, np.ndarray]],
    *,
    description: str = "",
    license: str | None = None,
) -> Path:
    """Writes a set of recovery points.

    Args:
        root: the set's folder; a set that is there already is replaced as a whole.
        scenarios: from `make_point`.
        pictures: by point's id and camera name: (K, H, W, 3) uint8, the recovery point last.
        description: free text.
        license: SPDX identifier, or None.

    Raises:
        ScenarioError: there are none, or a limit of the format is exceeded.
    """
    return write_scenarios(
        root,
        scenarios,
        description=description,
        license=license,
        frames=_last_frames(scenarios, pictures),
    )


def _last_frames(
    scenarios: Sequence[Scenario], pictures: Mapping[str, Mapping[str, np.ndarray]]
) -> Iterable[LastFrames]:
    for scenario in scenarios:
        png = {
            CAMERA_PREFIX + camera: tuple(encode_png(picture) for picture in stack)
            for camera, stack in pictures[scenario.id].items()
        }
        yield LastFrames(scenario.id, scenario.sha256(), len(scenario.prefix), png)


def pixels_sha256(picture: np.ndarray) -> str:
    """Hash of a picture's shape and pixels, (H, W, 3) uint8."""
    digest = hashlib.sha256(repr(picture.shape).encode())
    digest.update(np.ascontiguousarray(picture, np.uint8).tobytes())
    return digest.hexdigest()


__all__ = [
    "PointSet",
    "RobotPoint",
    "make_point",
    "point_of",
    "read_points",
    "write_points",
]
