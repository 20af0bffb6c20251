"""`roborecover export-ema`: the averaged weights of a training run as a plain checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = "write a plain checkpoint with the averaged weights of a lerobot-train run"


@dataclass(frozen=True, kw_only=True)
class ExportEmaOptions:
    """Which checkpoint to read, and where to write."""

    checkpoint: Path = option(positional=True)
    """checkpoints/<step> (or checkpoints/last) of the run."""
    out: Path
    """Folder to write; new or empty."""


OPTIONS = ExportEmaOptions


def run(options: ExportEmaOptions) -> int:
    from lerobot_roborecover.policies.export_ema import export_ema

    count = export_ema(options.checkpoint.resolve(), options.out)
    print(f"{options.out}: {count} averaged parameter tensors\nuse it with --policy.path={options.out}")
    return 0
