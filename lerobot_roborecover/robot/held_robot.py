"""Passes on to a connected robot; connecting and disconnecting are left to the run that holds it."""

from __future__ import annotations

from typing import Any

from lerobot.robots import Robot

from lerobot_roborecover.robot.config_held_robot import HeldRobotConfig
from lerobot_roborecover.robot.connection import asking


class HeldRobot(Robot):
    """A connected robot as a further `Robot`."""

    config_class = HeldRobotConfig
    name = "roborecover_held"

    def __init__(self, config: HeldRobotConfig):
        self.held: Robot = config.robot
        self.name = self.robot_type = self.held.name
        self.id, self.calibration = self.held.id, self.held.calibration
        self.cameras = getattr(self.held, "cameras", {})

    @property
    def observation_features(self) -> dict:
        return self.held.observation_features

    @property
    def action_features(self) -> dict:
        return self.held.action_features

    @property
    def is_connected(self) -> bool:
        return self.held.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.held.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        """Nothing: it is connected."""

    def calibrate(self) -> None:
        """Nothing: that is done when it is connected."""

    def configure(self) -> None:
        """Nothing: that is done when it is connected."""

    def get_observation(self) -> dict[str, Any]:
        """The robot's own; a robot that does not answer is a `RobotLostError`."""
        with asking(self.held):
            return self.held.get_observation()

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """The robot's own; a robot that does not answer is a `RobotLostError`."""
        with asking(self.held):
            return self.held.send_action(action)

    def disconnect(self) -> None:
        """Nothing: the run that holds the robot does it."""

    def __del__(self) -> None:
        """Nothing: LeRobot's would disconnect."""
