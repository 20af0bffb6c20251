"""A robot configuration that stands for a robot which is connected already.

`build_rollout_context` connects a robot anew for every policy. Given this configuration, it gets the one that
the run holds, so that the robot neither drops its torque nor closes its cameras between policies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("roborecover_held")
@dataclass
class HeldRobotConfig(RobotConfig):
    """Not for a command line: `robot` is the connected robot itself."""

    robot: Any = None
