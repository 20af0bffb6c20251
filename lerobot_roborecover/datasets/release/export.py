"""Converted scenarios back to the release's JSON files and split tables, byte for byte."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.datasets.release.convert import Problem
from lerobot_roborecover.datasets.release.json_form import KEY, to_json
from lerobot_roborecover.datasets.release.tables import (
    SplitRow,
    check_row,
    format_table,
    safe_path,
    table_name,
)
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir


def export_release(scenarios: Sequence[Scenario], out: str | os.PathLike[str]) -> list[Problem]:
    """Writes converted scenarios back as the release's JSON files and split tables.

    Args:
        scenarios: as `read_release` made them, of any of the platforms.
        out: a new or empty folder.

    Returns:
        Files whose hash differs from the one in their split table.

    Raises:
        ScenarioError: the folder is not empty, or a scenario was not made from a release; nothing is written
            outside the folder, whatever a dataset's provenance says.
    """
    out = Path(out)
    changed = []
    tables: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    with atomic_dir(out) as folder:
        for scenario in scenarios:
            data = to_json(scenario)
            number, note, row = _export_note(scenario)
            target = folder / row.path
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with open(target, "xb") as file:
                    file.write(data)
            except OSError as err:
                raise ScenarioError(f"scenario {scenario.id}: {row.path} cannot be written: {err}") from None
            if hashlib.sha256(data).hexdigest() != row.cells["sha256"]:
                changed.append(
                    Problem(str(row.path), None, scenario.id, "its hash is not that of its split table")
                )
            tables.setdefault(table_name(scenario.platform, scenario.split), []).append((number, note))
        for name, rows in tables.items():
            rows.sort(key=lambda item: item[0])
            form = rows[0][1]["table"]
            target = folder / safe_path(name, "split table")
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(
                format_table([dict(n["split_row"]) for _, n in rows], form["newline"], form["bom"])
            )
    return changed


def _export_note(scenario: Scenario) -> tuple[int, Mapping[str, Any], SplitRow]:
    """Row number, provenance note and split row of a converted scenario, checked again: it may come from
    anyone."""
    note = scenario.provenance[KEY]
    try:
        number, cells, table = note["row"], note["split_row"], note["table"]
        good = type(number) is int and table["newline"] in ("\n", "\r\n") and type(table["bom"]) is bool
        good = (
            good and all(isinstance(c, str) for c in cells.values()) and set(cells) >= {"sample_id", "path"}
        )
        if not good:
            raise ValueError
        return number, note, check_row(number, dict(cells))
    except (KeyError, TypeError, AttributeError, ValueError) as err:
        detail = f": {err}" if isinstance(err, ScenarioError) else ""
        raise ScenarioError(
            f"scenario {scenario.id}, field provenance.{KEY}: not what the conversion of a release "
            f"writes{detail}; only converted scenarios can be exported"
        ) from None
