"""`roborecover check policy`: what can go wrong with a policy, before an hour is spent."""

from __future__ import annotations

from collections.abc import Sequence

HELP = "try a policy for a few steps and look for the usual mistakes; takes lerobot-eval's arguments, --json"


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    from lerobot_roborecover.evaluation.check_policy import main

    return main(argv)
