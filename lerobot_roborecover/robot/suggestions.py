"""A failure detector beside a policy on a robot: it suggests a moment, and a person decides."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.policies.detectors.interface import Detector, DetectorError, DetectorHistory
from lerobot_roborecover.policies.detectors.online import OnlineDetector
from lerobot_roborecover.robot.points import CAMERA_PREFIX


class FailureWatch:
    """Shows every step of an episode to a detector, until its first alarm.

    Args:
        what: as the commands take it: a checkpoint, or a kind with options.
        features: of the robot's observations, by LeRobot key.
        device: where the detector runs; None takes its own.

    Raises:
        DetectorError: it cannot be loaded, never triggers by itself, or needs what a robot does not give.
    """

    def __init__(self, what: str, features: Mapping[str, Any], device: str | None = None):
        from lerobot_roborecover.policies.detectors.loading import load_detector

        detector = load_detector(what, device)
        _check(what, detector, features)
        self.what = what
        self._online = OnlineDetector(detector)
        self._history: DetectorHistory | None = None
        self._spent_s, self._calls = 0.0, 0

    @property
    def mean_s(self) -> float:
        """Seconds that it takes for a step."""
        return self._spent_s / max(self._calls, 1)

    def begin(self) -> None:
        """Begins an episode."""
        self._history = self._online.start(0)

    def alarms(self, frame: Mapping[str, Any], instruction: str) -> bool:
        """Whether this step is the episode's first alarm.

        Args:
            frame: the step as LeRobot's datasets have it: pictures (H, W, 3) uint8, vectors float32.
            instruction: of the task.
        """
        if self._history is None:
            return False
        begun = time.perf_counter()
        verdicts = self._online.judge([self._history], [_observation(frame)], [instruction])
        self._spent_s += time.perf_counter() - begun
        self._calls += 1
        if not verdicts.triggers[0]:
            return False
        self._history = None
        return True


def _check(what: str, detector: Detector, features: Mapping[str, Any]) -> None:
    problem = ""
    if not detector.fitted:
        problem = "has not been fitted; `roborecover detect evaluate --detector` fits and saves it"
    elif not detector.decides:
        problem = "has no threshold, and would never trigger. Write it as an option: threshold=NUMBER"
    elif detector.needs.of_policy:
        problem = (
            "looks into the policy that acts, which LeRobot's inference engine holds here. Name one that "
            "reads observations alone"
        )
    elif detector.needs.truth:
        problem = f"needs to know the {detector.needs.truth.replace('_', ' ')}, which no robot knows"
    else:
        missing = [key for key in detector.needs.features if key not in features]
        if missing:
            problem = f"reads {missing[0]}; the robot gives {', '.join(sorted(features))}"
    if problem:
        raise DetectorError(f"--detector={what}: {problem}")


def _observation(frame: Mapping[str, Any]) -> dict[str, Any]:
    """A frame as detectors take it: pictures (3, H, W) float32 in [0, 1], vectors float32."""
    import torch

    found = {}
    for key, value in frame.items():
        if not key.startswith("observation."):
            continue
        array = np.asarray(value)
        if key.startswith(CAMERA_PREFIX):
            array = array.transpose(2, 0, 1).astype(np.float32) / 255
        found[key] = torch.as_tensor(array.astype(np.float32))
    return found
