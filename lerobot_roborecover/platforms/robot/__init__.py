"""Real robots, as far as scenario sets and reports need a platform: nothing here simulates."""

from lerobot_roborecover.platforms.robot.platform import PLATFORM

__all__ = ["PLATFORM"]
