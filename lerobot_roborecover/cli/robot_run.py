"""`roborecover robot run`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import CommandLine, ConfigSource

HELP = (
    "Run a plan of recovery points and policies on a robot, blind and in random order; takes LeRobot's "
    "--robot.* and --teleop.*."
)
SOURCE = ConfigSource(
    "roborecover robot run",
    ("lerobot_roborecover.robot.commands", "PlanRunConfig"),
    chosen=(),
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the command line to LeRobot's parser."""
    return run_config_command(SOURCE, "lerobot_roborecover.robot.commands:run_plan", argv, HELP, _check_plan)


def _check_plan(line: CommandLine) -> None:
    """Refuses a plan, or policies of it, that cannot be used."""
    from lerobot_roborecover.robot.plan import check_policies, read_plan

    path = Path(line.value("plan") or "plan.yaml")
    if path.is_file():
        check_policies(read_plan(path))
