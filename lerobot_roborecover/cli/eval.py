"""`roborecover eval`: the fast runner, in `lerobot-eval`'s own words."""

from __future__ import annotations

import os
from collections.abc import Sequence

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import ENV, POLICY, ConfigSource
from lerobot_roborecover.evaluation.options import ALIASES

HELP = "evaluate a policy, every simulator busy; takes lerobot-eval's arguments and --runner.*"
SOURCE = ConfigSource(
    "roborecover eval",
    ("lerobot_roborecover.evaluation.runner", "RecoveryEvalConfig"),
    required=(ENV, POLICY),
    short=ALIASES,
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    # Before torch is loaded: threads of a policy on the CPU that spin while they wait for each other take the
    # cores from the simulators. It changes no number.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    return run_config_command(SOURCE, "lerobot_roborecover.evaluation.runner:main", argv, HELP)
