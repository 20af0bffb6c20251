"""RoboTwin 2.0 on SAPIEN: the task code of a checkout of its own."""

from lerobot_roborecover.platforms.robotwin.platform import PLATFORM

__all__ = ["PLATFORM"]
