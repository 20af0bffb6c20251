"""Writes the dataset that a stage makes of another one: fewer scenarios, the decisions so far and its own."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover._version import __version__
from lerobot_roborecover.curation.funnel import (
    Decision,
    attrition_table,
    carry_decisions,
    count_stages,
    read_decisions,
    record_decisions,
)
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir


def write_stage(
    out: Path,
    source: Path | None,
    scenarios: Sequence[Scenario],
    decisions: Iterable[Decision],
    record: tuple[str, Mapping[str, Any]],
    manifest: Mapping[str, Any],
) -> Path:
    """Writes a stage's scenario dataset; it appears as a whole, or not at all.

    Args:
        out: new or empty.
        source: the dataset that the stage was given, whose decisions and last frames go along; None where it
            is no folder. Episodes do not: they are rendered once the set is final (`datasets/render.py`).
        scenarios: that stay.
        decisions: of this stage, on all that it was given.
        record: name and content of the JSON file that says how the stage ran.
        manifest: of the source.

    Raises:
        ScenarioError: `out` is not new, or no scenario stays.
    """
    decisions = list(decisions)
    if not scenarios:
        before = read_decisions(source) if source else []
        raise ScenarioError(
            f"no scenario stays, so {out} is not written:\n"
            f"{attrition_table(count_stages([*before, *decisions]))}"
        )
    name, content = record
    document = {
        "schema_version": 1, "written_by": {"lerobot_env_roborecover": __version__}, **content,
    }  # fmt: skip
    frames = FrameStore(source) if source else None
    with atomic_dir(out) as folder:
        write_scenarios(
            folder,
            scenarios,
            description=manifest.get("description", ""),
            license=manifest.get("license"),
            frames=() if frames is None else (frames.of(s) for s in scenarios if s.id in frames),
        )
        if source:
            carry_decisions(source, folder)
        record_decisions(folder, decisions)
        (folder / FOLDER / name).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return out
