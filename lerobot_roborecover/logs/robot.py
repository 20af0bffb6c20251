"""What a robot's trial has beside the fields that every row has: start error, verdict, rater, reset time.

A robot cannot be put back exactly, so each trial says how far its start was from the recovery point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

type Verdict = Literal["success", "failure", "invalid"]

VERDICTS = ("success", "failure", "invalid")
MAX_CAMERAS = 64
MAX_JOINTS = 64


@dataclass(frozen=True)
class CameraError:
    """How a camera's live picture differs from the recorded one; None where not measured."""

    background_px: float | None = None
    """Shift of the static background: the camera moved by that much."""
    object_px: float | None = None
    """Shift of the object region."""
    similarity: float | None = None
    """Normalised correlation of the object region after that shift, -1 to 1."""
    tag_mm: float | None = None
    """Largest shift of a fiducial tag that both pictures show."""
    moving: bool = False
    """Whether the camera is on the arm: it shifts with the arm, and says nothing of the scene."""


@dataclass(frozen=True)
class StartError:
    """How far the start of a trial was from its recovery point."""

    joints: Mapping[str, float] = field(default_factory=dict)
    """Measured minus recorded position by joint, in the robot's units."""
    cameras: Mapping[str, CameraError] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    """What was outside the tolerance, one line each; empty where the trial may be run."""

    def worst(self, measure: str) -> float | None:
        """The largest value over cameras of a measure, the lowest of `similarity`; None where none was taken.

        Cameras on the arm are left out.

        Args:
            measure: a field of `CameraError`, or `joint`.
        """
        if measure == "joint":
            values = [abs(v) for v in self.joints.values()]
        else:
            found = [getattr(camera, measure) for camera in self.cameras.values() if not camera.moving]
            values = [v for v in found if v is not None]
        if not values:
            return None
        return min(values) if measure == "similarity" else max(values)

    def as_json(self) -> dict[str, Any]:
        """Plain values, rounded."""
        return {
            "joints": {n: round(float(v), 4) for n, v in self.joints.items()},
            "cameras": {
                name: {k: round(float(v), 4) if isinstance(v, float) else v for k, v in asdict(error).items()}
                for name, error in self.cameras.items()
            },
            "problems": list(self.problems),
        }

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> StartError:
        """From `as_json`'s values, which `check_robot` has checked."""
        cameras = {name: CameraError(**camera) for name, camera in values["cameras"].items()}
        return cls(dict(values["joints"]), cameras, tuple(values["problems"]))


@dataclass(frozen=True)
class RobotTrial:
    """The field `robot` of a trial row: what a simulated trial does not have."""

    robot_type: str
    calibration_sha256: str
    """Hash of the robot's calibration; empty where the robot has none."""
    verdict: Verdict
    rater: str
    """Who gave the verdict; a pseudonym."""
    code: str
    """What the rater knew the policy as."""
    start_error: StartError | None
    """None where the start was not measured."""
    reset_s: float | None = None
    """Seconds that putting robot and scene back took, all attempts together."""
    attempts: int = 0
    """How often the scene was measured before the trial was run or given up."""
    duration_s: float = 0.0
    """Seconds that the policy ran."""
    block: int = 0
    order: int = 0
    """Place of the trial in the run, from 0."""
    episode: int | None = None
    """Episode of the rollout dataset; None where nothing was recorded."""
    note: str = ""
    clock_jump_s: float = 0.0
    """How far the wall clock moved against the monotonic clock during the trial."""

    def as_json(self) -> dict[str, Any]:
        """Plain values, as a row holds them."""
        found = asdict(self)
        found["start_error"] = None if self.start_error is None else self.start_error.as_json()
        return found

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> RobotTrial:
        """From a row's field `robot`."""
        start = values["start_error"]
        error = None if start is None else StartError.of_json(start)
        given: dict[str, Any] = {**values, "start_error": error}
        return cls(**given)


_TEXTS = {"robot_type": 256, "calibration_sha256": 64, "rater": 256, "code": 256, "note": 10_000}
_COUNTS = ("attempts", "block", "order")
_NUMBERS = ("duration_s", "clock_jump_s")


def problem_of(value: object) -> str:
    """What is wrong with the field `robot` of a row; empty where nothing is.

    Args:
        value: from JSON.
    """
    if value is None:
        return ""
    if not isinstance(value, dict):
        return "neither null nor an object"
    names = set(RobotTrial.__dataclass_fields__)
    if value.keys() != names:
        return f"its field {min(value.keys() ^ names)!r} is missing or not known"
    for name, limit in _TEXTS.items():
        text = value[name]
        if not isinstance(text, str) or len(text) > limit:
            return f"its {name} is not text of at most {limit} characters"
        try:
            text.encode()
        except UnicodeEncodeError:
            return f"its {name} holds half a character (a lone surrogate)"
    if value["verdict"] not in VERDICTS:
        return f"its verdict is not one of {', '.join(VERDICTS)}"
    for name in _COUNTS:
        if type(value[name]) is not int or not 0 <= value[name] <= 10**6:
            return f"its {name} is not a count"
    if not all(_is_number(value[name]) for name in _NUMBERS):
        return "its durations are not finite numbers"
    if value["reset_s"] is not None and not (_is_number(value["reset_s"]) and value["reset_s"] >= 0):
        return "its reset_s is neither null nor seconds"
    if value["episode"] is not None and (type(value["episode"]) is not int or value["episode"] < 0):
        return "its episode is neither null nor a number from 0"
    return _start_problem(value["start_error"])


def _start_problem(value: Any) -> str:
    if value is None:
        return ""
    if not isinstance(value, dict) or value.keys() != {"joints", "cameras", "problems"}:
        return "its start_error is not an object with joints, cameras and problems"
    joints, cameras, problems = value["joints"], value["cameras"], value["problems"]
    if not isinstance(joints, dict) or len(joints) > MAX_JOINTS or not all(map(_is_number, joints.values())):
        return f"its start_error.joints is not an object of at most {MAX_JOINTS} finite numbers"
    if not isinstance(problems, list) or not all(isinstance(p, str) and len(p) <= 1000 for p in problems):
        return "its start_error.problems is not a list of texts"
    known = isinstance(cameras, dict) and len(cameras) <= MAX_CAMERAS
    if not known or not all(map(_is_camera, cameras.values())):
        return f"its start_error.cameras is not an object of at most {MAX_CAMERAS} cameras' measures"
    return ""


def _is_camera(value: Any) -> bool:
    """Whether it has the fields of a `CameraError`; rows of earlier versions lack `moving`."""
    if not isinstance(value, dict):
        return False
    measures = CameraError.__dataclass_fields__.keys() - {"moving"}
    if value.keys() - {"moving"} != measures or type(value.get("moving", False)) is not bool:
        return False
    return all(value[name] is None or _is_number(value[name]) for name in measures)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)
