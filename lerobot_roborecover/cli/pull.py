"""`roborecover dataset pull`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = "Pull a dataset from the Hugging Face Hub into a new folder: all of it, checked, or nothing."


@dataclass(frozen=True, kw_only=True)
class PullOptions:
    """What to pull, and where to."""

    repo_id: str = option(positional=True, metavar="ORG/NAME")
    """Dataset on the Hub."""
    revision: str | None = None
    """Tag, branch or commit; a commit or a version tag makes results repeatable."""
    out: Path
    """New folder."""
    evaluation_only: bool = False
    """meta/roborecover/ alone, without episodes."""


OPTIONS = PullOptions


def run(options: PullOptions) -> int:
    from lerobot_roborecover.datasets.pull import pull_dataset

    done = pull_dataset(
        options.repo_id, options.out, revision=options.revision, evaluation_only=options.evaluation_only
    )
    print(f"{done.root}: {done.files} files, {done.bytes / 1e6:.1f} MB\nrevision {done.commit}")
    return 0
