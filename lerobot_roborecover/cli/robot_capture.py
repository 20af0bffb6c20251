"""`roborecover robot capture`."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import POLICY, ConfigSource

HELP = (
    "Run a policy on a robot, always recording, and mark where something goes wrong; takes LeRobot's "
    "--robot.*, --teleop.* and --policy.*."
)
SOURCE = ConfigSource(
    "roborecover robot capture",
    ("lerobot_roborecover.robot.commands", "CaptureConfig"),
    chosen=(POLICY,),
    required=(POLICY,),
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    return run_config_command(SOURCE, "lerobot_roborecover.robot.commands:run_capture", argv, HELP)
