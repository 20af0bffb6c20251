"""`roborecover check policy`: what can go wrong with a policy, before an hour is spent."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import ENV, POLICY, ConfigSource
from lerobot_roborecover.evaluation.options import JSON

HELP = "try a policy for a few steps and look for the usual mistakes; takes lerobot-eval's arguments, --json"
SOURCE = ConfigSource(
    "roborecover check policy",
    ("lerobot_roborecover.evaluation.check_policy", "CheckPolicyConfig"),
    required=(ENV, POLICY),
    short=JSON,
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    return run_config_command(SOURCE, "lerobot_roborecover.evaluation.check_policy:main", argv, HELP)
