"""`roborecover export-ema`: the averaged weights of a training run as a plain checkpoint."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write a plain checkpoint with the averaged weights of a lerobot-train run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds this command's arguments."""
    parser.add_argument("checkpoint", type=Path, help="checkpoints/<step> (or checkpoints/last) of the run")
    parser.add_argument("--out", type=Path, required=True, help="folder to write; new or empty")


def run(args: argparse.Namespace) -> int:
    """Writes the checkpoint."""
    from lerobot_roborecover.policies.export_ema import export_ema

    count = export_ema(args.checkpoint.resolve(), args.out)
    print(f"{args.out}: {count} averaged parameter tensors\nuse it with --policy.path={args.out}")
    return 0
