"""Copies a trained policy as it ships: half precision, for a CPU, without the training's settings and places.

    python -m recipes.ship CHECKPOINT policies/pusht/NAME

LeRobot loads them into float32 again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from lerobot_roborecover.policies.ship import ship


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    ship(args.checkpoint, args.out)


if __name__ == "__main__":
    main()
