"""`roborecover merge`: one trial log from those of shards."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = "join the trial logs of shards; refuses logs of different protocols"


@dataclass(frozen=True, kw_only=True)
class MergeOptions:
    """Which logs to join."""

    logs: tuple[Path, ...] = option(positional=True)
    """Trial logs."""
    out: Path
    """The merged log."""
    force: bool = False
    """Replace a file that exists at --out."""
    allow_unequal_trials: bool = option(False, old=("unequal",))
    """Accept scenarios with fewer trials than others."""


OPTIONS = MergeOptions


def run(options: MergeOptions) -> int:
    """Merges and says what came together."""
    from lerobot_roborecover.logs.merge import merge
    from lerobot_roborecover.utils.text import pluralize

    merged = merge(options.logs, options.out, unequal=options.allow_unequal_trials, force=options.force)
    scenarios = len({r.scenario_id for r in merged.rows})
    for remark in merged.remarks:
        print(f"note: {remark}", file=sys.stderr)
    found = f"{pluralize(len(merged.rows), 'trial')} of {pluralize(scenarios, 'scenario')}"
    print(f"{found} from {pluralize(len(options.logs), 'log')} in {options.out}")
    return 0
