"""Whether RoboTwin's robot here is the one of a record: with all joints at 0, the robot alone decides
`endpose`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.release.json_form import KEY
from lerobot_roborecover.platforms.robotwin.robot import SIDES, RobotwinRobot, another_robot
from lerobot_roborecover.scenario import Scenario, ScenarioError

_ARM_JOINTS = np.arange(14) % 7 != 6


def initial_state_of(scenario: Scenario) -> Mapping[str, Any]:
    """What the record says of its first state."""
    return scenario.provenance[KEY]["record"]["initial_state"]


def check_robot(robot: RobotwinRobot, said: Mapping[str, Any]) -> dict[str, float] | None:
    """Compares a robot with the one that recorded, from its files alone.

    Args:
        robot: the checkout's.
        said: `initial_state` of a RoboTwin record.

    Returns:
        Millimetres between the wrists, by side; None where a joint is not at 0, and nothing follows.

    Raises:
        ScenarioError: it is another one; the message says where its wrists are.
    """
    if np.asarray(said["joint_vector"], dtype=np.float64)[_ARM_JOINTS].any():
        return None
    found = robot.from_recorded_mm({side: said[f"{side}_endpose"] for side in SIDES})
    wrong = another_robot(found)
    if wrong:
        raise ScenarioError(
            f"field initial_state: the robot {robot.folder} is another than the record's: {wrong}. Nothing "
            "recorded there replays on it: put RoboTwin's own embodiment in its place (roborecover doctor "
            "--platform robotwin says how)"
        )
    return found
