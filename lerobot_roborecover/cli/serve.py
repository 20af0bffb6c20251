"""`roborecover serve`: a LeRobot policy for simulators elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_roborecover.cli.config_command import run_config_command
from lerobot_roborecover.evaluation.early_checks import POLICY, ConfigSource

HELP = "serve a LeRobot policy over openpi's websocket protocol; takes --policy.path, --host and --port"
SOURCE = ConfigSource(
    "roborecover serve",
    ("lerobot_roborecover.policies.remote.serve", "ServeConfig"),
    chosen=(POLICY,),
    required=(POLICY,),
)


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    return run_config_command(SOURCE, "lerobot_roborecover.policies.remote.serve:main", argv, HELP)
