"""`roborecover robot run`."""

from __future__ import annotations

from collections.abc import Sequence

HELP = (
    "Run a plan of recovery points and policies on a robot, blind and in random order; takes LeRobot's "
    "--robot.* and --teleop.*."
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    from lerobot_roborecover.utils.plugins import register_plugins

    register_plugins()
    from lerobot_roborecover.robot.commands import run_plan

    return run_plan(argv)
