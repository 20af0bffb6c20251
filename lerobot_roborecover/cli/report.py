"""`roborecover report`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.analysis.options import Gallery, Options
from lerobot_roborecover.utils.options import option

HELP = (
    "Turn trial logs into a report: tables with intervals, figures and a scenario gallery in one "
    "HTML file that "
    "opens from disk, and the same as Markdown, CSV, LaTeX, SVG, PNG and JSON."
)


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Which trials, and how they are analysed; shared by the commands on trial logs."""

    logs: tuple[str, ...] = option(positional=True, metavar="[NAME=]LOG[,LOG]")
    """Trial log, or a folder that holds trials.jsonl; NAME replaces the policy's own name; after one NAME
    stand the logs of one policy, from both starts, or of several training runs of one method."""
    platform: str | None = None
    """Take this platform's rows only."""
    analysis: Options = field(default_factory=Options)


@dataclass(frozen=True, kw_only=True)
class ReportOptions(LogOptions):
    """What to report, and where to."""

    out: Path = Path("outputs/report")
    """Folder of the report."""
    title: str = "Recovery report"
    """Heading of the report."""
    gallery: Gallery = field(default_factory=Gallery)


OPTIONS = ReportOptions


def run(options: ReportOptions) -> int:
    """Writes the report and prints its headline."""
    from lerobot_roborecover.analysis.make import report

    made = report(
        options.logs,
        options.out,
        platform=options.platform,
        title=options.title,
        options=options.analysis,
        gallery=options.gallery,
        command=shlex.join(["roborecover", *sys.argv[1:]]),
    )
    for remark in made.remarks:
        print(f"note: {remark}", file=sys.stderr)
    print(made.text())
    return 0
