"""`roborecover eval`: the fast runner, in `lerobot-eval`'s own words."""

from __future__ import annotations

import os
from collections.abc import Sequence

HELP = "evaluate a policy, every simulator busy; takes lerobot-eval's arguments and --runner.*"


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    # Before torch is loaded: threads of a policy on the CPU that spin while they wait for each other take the
    # cores from the simulators. It changes no number.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from lerobot_roborecover.evaluation.runner import main

    return main(argv)
