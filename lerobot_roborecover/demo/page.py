"""The page of pictures: one self-contained HTML file that opens from disk and prints."""

from __future__ import annotations

import base64
import importlib.resources
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover import __version__
from lerobot_roborecover.analysis.summary import UNDERPOWERED_BELOW, Estimate, Summary
from lerobot_roborecover.scenario import Outcome, Scenario, Start
from lerobot_roborecover.whole import write_whole

_TITLES = {Start.RECOVERY: "recovery point", Start.INITIAL: "initial state"}


@dataclass(frozen=True)
class Mark:
    """How one trial ended, as a shape with a colour."""

    kind: str
    """`success`, `failure` or `invalid`; the style sheet gives each a shape of its own."""
    sign: str
    text: str
    """In words, for readers without the picture."""


@dataclass(frozen=True)
class Card:
    """One scenario on the page."""

    id: str
    task: str
    instruction: str
    source: str
    picture: str
    """Data URI of the recovery frame; empty where there is none."""
    marks: Mapping[str, tuple[Mark, ...]]
    """By start, in the order of the trials."""


def write_page(
    path: Path,
    scenarios: Sequence[Scenario],
    rows: Sequence[Mapping[str, Any]],
    summary: Summary,
    frames: Mapping[str, Path],
    problem: str,
    commands: Sequence[str],
) -> Path:
    """Writes the page.

    Args:
        path: the HTML file.
        scenarios: what was run.
        rows: their trials.
        summary: of these rows.
        frames: JPEG files by scenario id.
        problem: why some frames are missing; empty when none is.
        commands: command lines that made the trials.

    Returns:
        `path`.
    """
    import jinja2

    source = importlib.resources.files("lerobot_roborecover.demo").joinpath("page.html.j2").read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"percent": _percent, "interval": _interval, "bar": _bar}
    cells: dict[str, list[Card]] = {}
    order = [cell.cell for part in summary.starts.values() for cell in part.cells]
    for scenario in sorted(scenarios, key=lambda s: (order.index(s.cell) if s.cell in order else -1, s.id)):
        cells.setdefault(scenario.cell, []).append(_card(scenario, rows, frames.get(scenario.id)))
    versions = rows[0]["versions"] if rows else {}
    text = environment.from_string(source).render(
        summary=summary,
        titles=_TITLES,
        underpowered_below=UNDERPOWERED_BELOW,
        cells=cells,
        problem=problem,
        commands=commands,
        versions={"roborecover": __version__, **versions},
        finished=max((row["finished_at"] for row in rows), default=""),
    )
    write_whole(path, text)
    return path


def _card(scenario: Scenario, rows: Sequence[Mapping[str, Any]], frame: Path | None) -> Card:
    own = sorted((r for r in rows if r["scenario_id"] == scenario.id), key=lambda r: r["trial"])
    picture = ""
    if frame is not None:
        picture = f"data:image/jpeg;base64,{base64.b64encode(frame.read_bytes()).decode()}"
    driver = f", {scenario.source_policy}" if scenario.source_policy else ""
    return Card(
        id=scenario.id,
        task=scenario.task.name,
        instruction=scenario.task.instruction,
        source=f"{scenario.source.value}{driver}",
        picture=picture,
        marks={start: tuple(_mark(r) for r in own if r["start"] == start) for start in _TITLES},
    )


def _mark(row: Mapping[str, Any]) -> Mark:
    outcome = Outcome(row["outcome"])
    if outcome is Outcome.SUCCESS:
        return Mark("success", "✓", f"success in {row['steps']} steps")
    if outcome.valid:
        return Mark("failure", "✗", f"not solved in {row['steps']} steps")
    return Mark("invalid", "!", f"invalid: {outcome.value}, {row['reason']}")


def _percent(value: float) -> str:
    return f"{100 * value:.1f}"


def _interval(estimate: Estimate) -> str:
    if estimate.low != estimate.low:  # NaN
        return "n/a"
    return f"{_percent(estimate.low)} to {_percent(estimate.high)}"


def _bar(estimate: Estimate) -> dict[str, float]:
    """Positions in per cent of a dot and its whisker."""
    known = estimate.low == estimate.low
    low, high = (estimate.low, estimate.high) if known else (estimate.value, estimate.value)
    return {"at": 100 * estimate.value, "low": 100 * low, "width": 100 * (high - low)}
