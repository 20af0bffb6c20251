"""`roborecover robot capture`."""

from __future__ import annotations

from collections.abc import Sequence

HELP = (
    "Run a policy on a robot, always recording, and mark where something goes wrong; takes LeRobot's "
    "--robot.*, --teleop.* and --policy.*."
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    from lerobot_roborecover.utils.plugins import register_plugins

    register_plugins()
    from lerobot_roborecover.robot.commands import run_capture

    return run_capture(argv)
