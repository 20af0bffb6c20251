"""Contact sheets for the last look by a person: original, replay, and their difference; and a page of all."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.pages.page import render_page
from lerobot_roborecover.curation.funnel import Decision
from lerobot_roborecover.curation.validate.validation import Replays, ValidationRule
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.atomic_io import atomic_write

AMPLIFIED = 4
"""What differences are multiplied with, to be seen."""
_STRIP = 14
_SIDE = 240
"""Frames are shown at most this wide."""


def draw_sheet(
    scenario_id: str,
    step: int,
    originals: Mapping[str, np.ndarray],
    replays: Mapping[str, np.ndarray],
) -> bytes:
    """One scenario's sheet as a PNG: three rows a camera, one column a frame, the recovery point last.

    Args:
        scenario_id: for the labels.
        step: the recovery point.
        originals: (K, H, W, 3) uint8 by camera.
        replays: the same.
    """
    from PIL import Image, ImageDraw

    rows: list[tuple[str, np.ndarray]] = []
    for camera, pictures in originals.items():
        gap = np.abs(pictures.astype(np.int16) - replays[camera].astype(np.int16)) * AMPLIFIED
        rows += [
            (f"{scenario_id}  {camera}  original, steps {step + 1 - len(pictures)} to {step}", pictures),
            ("replay", replays[camera]),
            (f"difference x {AMPLIFIED}", np.minimum(gap, 255).astype(np.uint8)),
        ]
    bands = []
    for _, pictures in rows:
        strip = Image.fromarray(np.concatenate(list(pictures), axis=1))
        scale = min(_SIDE / pictures.shape[2], 1.0)
        bands.append(strip.resize((round(strip.width * scale), round(strip.height * scale))))
    sheet = Image.new("RGB", (max(b.width for b in bands), sum(b.height + _STRIP for b in bands)), "white")
    draw, top = ImageDraw.Draw(sheet), 0
    for (label, _), band in zip(rows, bands, strict=True):
        draw.text((2, top + 1), label, fill="black")
        sheet.paste(band, (0, top + _STRIP))
        top += band.height + _STRIP
    file = io.BytesIO()
    sheet.save(file, "PNG")
    return file.getvalue()


def write_page(
    path: Path,
    scenarios: Sequence[Scenario],
    replays: Mapping[str, Replays],
    decisions: Mapping[str, Decision],
    rule: ValidationRule,
    command: str,
) -> None:
    """Writes the page of all scenarios, the worst first.

    Args:
        path: the HTML file; sheets lie in `sheets/` beside it.
        scenarios: all that were validated.
        replays: by scenario id.
        decisions: by scenario id.
        rule: limits.
        command: how to reject one.
    """
    entries: list[dict[str, Any]] = [
        {
            "scenario": s,
            "replays": replays[s.id],
            "decision": decisions[s.id],
            "sheet": f"sheets/{s.id}.png" if (path.parent / "sheets" / f"{s.id}.png").exists() else "",
        }
        for s in sorted(scenarios, key=lambda s: _badness(replays[s.id], decisions[s.id], s.id))
    ]
    title = "Original, replay and difference"
    text = render_page(
        "replays.html.j2", title=title, with_files=True, entries=entries, rule=rule, command=command
    )
    atomic_write(path, text)


def _badness(replays: Replays, decision: Decision, scenario_id: str) -> tuple:
    """Dropped ones first, then the least alike, then the farthest away."""
    similar = replays.mean_ssim if replays.mean_ssim == replays.mean_ssim else 0.0
    away = max(replays.eef_mm, replays.object_mm) if replays.runs else float("inf")
    return decision.verdict == "kept", similar, -away, scenario_id
