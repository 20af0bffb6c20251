"""`roborecover serve`: a LeRobot policy for simulators elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

HELP = "serve a LeRobot policy over openpi's websocket protocol; takes --policy.path, --host and --port"


def pass_through(argv: Sequence[str]) -> int:
    """Hands the whole command line to LeRobot's parser."""
    from lerobot_roborecover.policies.remote.serve import main

    return main(argv)
