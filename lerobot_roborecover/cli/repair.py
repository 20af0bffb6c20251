"""`roborecover dataset repair`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = "Rebuild a dataset's meta/roborecover after LeRobot's tools (merge, delete, split) have worked on it."


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """What to repair."""

    dataset: Path = option(positional=True)
    """Folder that a tool has made."""
    sources: tuple[str, ...] = option(name="from", nargs="+", metavar="SOURCE")
    """Datasets it was made from."""
    dry_run: bool = False
    """Say what would be done, and change nothing."""


OPTIONS = RepairOptions


def run(options: RepairOptions) -> int:
    """Repairs, and says what it did."""
    from lerobot_roborecover.curation.repair import repair_dataset

    print("\n".join(repair_dataset(options.dataset, options.sources, dry_run=options.dry_run).lines))
    return 0
