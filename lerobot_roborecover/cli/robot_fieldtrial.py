"""`roborecover robot fieldtrial`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = (
    "Have fieldtrial (PyPI) schedule and label a plan's trials: write its study, or take its labels into the "
    "run's log."
)


@dataclass(frozen=True, kw_only=True)
class RobotFieldtrialOptions:
    """Which run, and what is written or read."""

    run: Path = option(positional=True, metavar="RUN")
    """Folder of the run, as `roborecover robot run --out` takes it."""
    plan: Path | None = option(None, metavar="FILE")
    """Plan to write a study of."""
    out: Path | None = option(None, metavar="STUDY")
    """Folder of fieldtrial's study."""
    options: str = option("", metavar="TEXT")
    """What `roborecover robot run` gets beside plan and folder: "--rater=kim --robot.type=..."."""
    labels: Path | None = option(None, metavar="FILE")
    """What `fieldtrial export --format jsonl` has written; its labels replace the verdicts of the log."""


OPTIONS = RobotFieldtrialOptions


def run(options: RobotFieldtrialOptions) -> int:
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.robot.fieldtrial import take_labels, write_study

    if options.labels is not None:
        take_labels(options.run, options.labels, print)
        return 0
    if options.plan is None or options.out is None:
        raise OptionError("name --plan and --out to write a study, or --labels to take fieldtrial's labels")
    path = write_study(options.plan, options.run, options.out, shlex.split(options.options))
    print(f"{path}\nthen: fieldtrial lock {options.out}, and fieldtrial serve {options.out} --lan")
    return 0
