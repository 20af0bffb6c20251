"""`lerobot-rollout --strategy.type=roborecover`: `roborecover robot capture` within LeRobot's own command.

LeRobot takes strategies of other packages after 0.6.1 (huggingface/lerobot#4559); it finds the class beside
its configuration, by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.rollout.configs import RolloutStrategyConfig
from lerobot.rollout.robot_wrapper import ThreadSafeRobot
from lerobot.rollout.strategies import RolloutStrategy

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.capture import capture
from lerobot_roborecover.robot.commands import ConsoleOptions, served_console
from lerobot_roborecover.robot.config_held_robot import HeldRobotConfig
from lerobot_roborecover.robot.held_robot import HeldRobot
from lerobot_roborecover.robot.suggestions import FailureWatch


@RolloutStrategyConfig.register_subclass("roborecover")
@dataclass(kw_only=True)
class RoboRecoverStrategyConfig(ConsoleOptions, RolloutStrategyConfig):
    """Records a policy, while a person marks where something goes wrong: recovery points are made of that."""

    capture_dir: Path = Path("outputs/robot/capture")
    """Folder of the LeRobotDataset; extended where it is there."""
    episodes: int = 10
    """How many to record."""
    limit_s: float = 30.0
    """Time limit of each, seconds."""
    detector: str = ""
    """A failure detector that suggests moments: a checkpoint, or a kind with options."""


class RoboRecoverStrategy(RolloutStrategy):
    """Records episodes on the robot that `lerobot-rollout` has connected.

    Args:
        config: of the strategy.
    """

    config: RoboRecoverStrategyConfig

    def setup(self, ctx: Any) -> None:
        """Checks what is asked for; the engine starts with each episode.

        Raises:
            OptionError: the task is not said, or actions are to be interpolated.
        """
        if not ctx.runtime.cfg.task:
            raise OptionError("--task: say what the policy is to do")
        if ctx.runtime.cfg.interpolation_multiplier != 1:
            raise OptionError(
                f"--interpolation_multiplier={ctx.runtime.cfg.interpolation_multiplier}: recovery points are "
                "recorded at the policy's own rate. Leave the option out"
            )

    def run(self, ctx: Any) -> None:
        """Records the episodes.

        Raises:
            RobotLostError: the robot, a camera or the phone does not answer; what was recorded is kept.
        """
        config, robot = self.config, ctx.hardware.robot_wrapper.inner
        ctx.hardware.robot_wrapper = ThreadSafeRobot(HeldRobot(HeldRobotConfig(robot=robot)))
        watch = FailureWatch(config.detector, ctx.data.dataset_features) if config.detector else None
        with served_console(config, robot) as console:
            capture(
                robot, ctx, Path(config.capture_dir), console, episodes=config.episodes,
                limit_s=config.limit_s, instruction=ctx.runtime.cfg.task, teleop=ctx.hardware.teleop,
                watch=watch,
            )  # fmt: skip

    def teardown(self, ctx: Any) -> None:
        """Stops the engine and disconnects; the robot stays where it is."""
        ctx.policy.inference.stop()
        robot = ctx.hardware.robot_wrapper.inner
        for device in (getattr(robot, "held", robot), ctx.hardware.teleop):
            if device is not None and device.is_connected:
                device.disconnect()
