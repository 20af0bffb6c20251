"""The summary of a build: what became of every candidate, what the splits hold, and how it was made."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.funnel import StageCounts, attrition_table, count_stages, read_decisions
from lerobot_roborecover.curation.pipeline.config import BuildPaths
from lerobot_roborecover.curation.split_dataset import check_splits, format_report
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.utils.atomic_io import atomic_write

FUNNEL_FILE = "funnel.md"


def write_summary(places: BuildPaths, config: Path, done: Sequence[Mapping[str, Any]]) -> str:
    """Writes the summary folder from the latest dataset that there is.

    Args:
        places: of the build.
        config: its file, which is copied.
        done: what `Pipeline.build` returned.

    Returns:
        The funnel as text; empty where nothing was decided yet.
    """
    rows: list[StageCounts] = []
    for root in (
        places.rendered,
        places.split,
        places.validated,
        places.screened,
        places.scenarios,
        places.candidates,
    ):
        if root.exists():
            rows = count_stages(read_decisions(root))
            break
    places.summary.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(config, places.summary / "build.yaml")
    atomic_write(places.summary / FUNNEL_FILE, markdown(rows))
    atomic_write(places.summary / "stages.json", json.dumps(list(done), indent=1) + "\n")
    if places.split.exists():
        atomic_write(places.summary / "splits.txt", format_report(check_splits(places.split, None)) + "\n")
        shutil.copyfile(places.split / FOLDER / "split.json", places.summary / "split.json")
    return attrition_table(rows) if rows else ""


def markdown(rows: Sequence[StageCounts]) -> str:
    """The funnel as a Markdown table, and the reasons below it."""
    lines = ["| stage | entered | kept | dropped | undecided |", "|---|---|---|---|---|"]
    reasons = ["", "| stage | dropped | because |", "|---|---|---|"]
    for row in rows:
        dropped = sum(n for _, n in row.dropped)
        lines.append(f"| {row.stage} | {row.entered} | {row.kept} | {dropped} | {row.undecided} |")
        reasons += [f"| {row.stage} | {n} | {reason.replace('|', '/')} |" for reason, n in row.dropped]
    return "\n".join([*lines, *(reasons if len(reasons) > 3 else [])]) + "\n"
