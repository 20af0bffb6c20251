"""A LeRobot `Robot` whose table, cameras and drives are simulated."""

from __future__ import annotations

from collections import deque
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot
from lerobot.robots.utils import ensure_safe_goal_position
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.clock import SteppedClock, WallClock
from lerobot_roborecover.robot.lab.config_lab_robot import LabRobotConfig
from lerobot_roborecover.robot.lab.world import TableWorld, World


def make_world(config: LabRobotConfig) -> World:
    """The world that a configuration names.

    Raises:
        OptionError: there is none of that name.
    """
    if config.world == "table":
        return TableWorld(config.size, config.tags)
    if config.world == "metaworld":
        from lerobot_roborecover.robot.lab.metaworld_world import MetaworldWorld

        return MetaworldWorld(config.size)
    if config.world == "so101":
        from lerobot_roborecover.robot.lab.so101_world import So101World

        return So101World(config.size)
    raise OptionError(f"--robot.world={config.world!r:.40}: the lab has table, so101 and metaworld")


class LabRobot(Robot):
    """The simulated lab's robot. Actions are position targets, as on an SO-101; each is one control step."""

    config_class = LabRobotConfig
    name = "roborecover_lab"

    def __init__(self, config: LabRobotConfig):
        super().__init__(config)
        self.config = config
        self.world = make_world(config)
        self.cameras = dict.fromkeys(self.world.cameras)
        self.clock = WallClock() if config.realtime else SteppedClock()
        self.joint_limits = {f"{j}.pos": limits for j, limits in self.world.limits.items()}
        """Calibrated range by joint."""
        self.joint_units = {f"{j}.pos": unit for j, unit in self.world.units.items()}
        self.scene = config.seed
        """Number of the present scene."""
        self._rng = np.random.default_rng(config.seed)
        self._connected = False
        self._steps = 0
        self._late: deque[dict[str, np.ndarray]] = deque(maxlen=config.latency_steps + 1)
        self._held: dict[str, np.ndarray] = {}
        self._effective = np.zeros(len(self.world.joints))

    @property
    def task(self) -> str:
        """Name of the world's task."""
        return self.config.task or next(iter(self.world.tasks))

    @property
    def instruction(self) -> str:
        return self.world.tasks[self.task]

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Positions, and a picture a camera."""
        shape = (self.config.size, self.config.size, 3)
        return {**self.action_features, **dict.fromkeys(self.world.cameras, shape)}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return {f"{joint}.pos": float for joint in self.world.joints}

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Switches the lab on and lays out its first scene."""
        if self._connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        self._connected, self._steps = True, 0
        self.new_scene(self.scene)

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def new_scene(self, number: int | None = None) -> None:
        """Lays out a scene from a seed; by default the next one."""
        self.scene = self.scene + 1 if number is None else number
        self.world.reset(self.task, self.scene)
        self._effective = self.world.positions()
        self._late.clear()

    def get_observation(self) -> dict[str, Any]:
        """Measured positions, and pictures that are `latency_steps` late."""
        self._check()
        measured = self.world.positions()
        measured = measured + self._rng.normal(0, self.config.joint_noise, measured.shape)
        found: dict[str, Any] = {
            f"{j}.pos": float(v) for j, v in zip(self.world.joints, measured, strict=True)
        }
        self._late.append({camera: self._picture(camera) for camera in self.world.cameras})
        return found | self._late[0]

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Moves towards a target for one control step."""
        self._check()
        goal = {n: float(action[n]) for n in self.action_features}
        if self.config.max_relative_target is not None:
            now = dict(zip(self.action_features, self.world.positions(), strict=True))
            goal = ensure_safe_goal_position(
                {n: (v, float(now[n])) for n, v in goal.items()}, float(self.config.max_relative_target)
            )
        target, play = np.array(list(goal.values())), self.config.backlash
        # A drive with play moves its load only once its own motion has taken the play up.
        self._effective = np.clip(self._effective, target - play, target + play)
        self.world.step(self._effective)
        self._steps += 1
        return goal

    def disconnect(self) -> None:
        """Switches the lab off."""
        self._check()
        self._connected = False

    def hidden_truth(self) -> dict[str, Any]:
        """Where everything is, and whether the task is done: for the simulated operator and for studies."""
        return {
            "objects": self.world.truth(),
            "solved": self.world.succeeded(),
            "boxes": {camera: self.world.boxes(camera) for camera in self.world.cameras},
        }

    def _check(self) -> None:
        if self._connected and 0 < self.config.unplug_at_step <= self._steps:
            self._connected = False
            raise DeviceNotConnectedError(f"{self} does not answer")
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected")

    def _picture(self, camera: str) -> np.ndarray:
        frozen = camera == self.world.cameras[0] and 0 < self.config.freeze_at_step <= self._steps
        if not frozen or camera not in self._held:
            clean = self.world.image(camera).astype(np.float32)
            noise = self._rng.standard_normal(clean.shape, dtype=np.float32) * self.config.image_noise
            self._held[camera] = np.clip(clean + noise, 0, 255).astype(np.uint8)
        return self._held[camera]
