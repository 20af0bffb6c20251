"""`roborecover robot restore`."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import ConfigSource

HELP = (
    "Put a robot and its scene back to a recovery point, and measure how far off the start is; takes "
    "LeRobot's --robot.*."
)
SOURCE = ConfigSource(
    "roborecover robot restore",
    ("lerobot_roborecover.robot.commands", "RestoreConfig"),
    chosen=(),
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    return run_config_command(SOURCE, "lerobot_roborecover.robot.commands:run_restore", argv, HELP)
