"""`roborecover robot restore`."""

from __future__ import annotations

from collections.abc import Sequence

HELP = (
    "Put a robot and its scene back to a recovery point, and measure how far off the start is; takes "
    "LeRobot's --robot.*."
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    from lerobot_roborecover.utils.plugins import register_plugins

    register_plugins()
    from lerobot_roborecover.robot.commands import run_restore

    return run_restore(argv)
