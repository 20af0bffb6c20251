"""`roborecover eval`: the fast runner, in `lerobot-eval`'s own words."""

from __future__ import annotations

import os
from collections.abc import Sequence

from lerobot_roborecover.policies.checkpoint import check_checkpoint

HELP = "evaluate a policy, every simulator busy; takes lerobot-eval's arguments and --runner.*"


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    # Before torch is loaded: threads of a policy on the CPU that spin while they wait for each other take the
    # cores from the simulators. It changes no number.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    _check_folder(argv)
    from lerobot_roborecover.evaluation.runner import main

    return main(argv)


def _check_folder(argv: Sequence[str]) -> None:
    """Refuses a checkpoint's folder that cannot be used before LeRobot is imported, which takes 10 s."""
    for name, _, path in (argument.partition("=") for argument in argv):
        if name == "--policy.path" and (path.startswith(("/", "./", "../")) or os.path.isdir(path)):
            check_checkpoint(path)
