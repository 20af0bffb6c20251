"""Detectors side by side on disk: tables, figures, frame strips, numbers, and one page with all of them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.detection_scores import write_scores
from lerobot_roborecover.analysis.figures.detection import (
    FrameStrip,
    detection_figures,
    finite,
    strip_figure,
)
from lerobot_roborecover.analysis.figures.style import Figure, png_of, svg_of
from lerobot_roborecover.analysis.pages.page import picture, render_page
from lerobot_roborecover.analysis.stats.contrasts import Contrast
from lerobot_roborecover.analysis.stats.detection import (
    DEVIATED,
    WILL_FAIL,
    Alarms,
    DetectionReport,
    ScoredTrial,
)
from lerobot_roborecover.analysis.stats.intervals import UNDEFINED, Estimate
from lerobot_roborecover.analysis.tables import Cell, Column, Table, to_csv, to_latex, to_markdown, to_text
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import claim_page

SCHEMA_VERSION = 1
NUMBERS_FILE, SCORES_FOLDER = "detectors.json", "scores"
DETECTION_FILES = ("detectors.html", "detectors.md", NUMBERS_FILE, "tables", SCORES_FOLDER)


@dataclass(frozen=True)
class MeasuredDetector:
    """One detector and its numbers."""

    name: str
    what: str
    """As the user wrote it."""
    reads: str
    fitted_to: str
    """What it was fitted to here; empty for one that was not."""
    probabilities: bool
    """Its scores are probabilities of needing help."""
    report: DetectionReport
    cost_ms: float
    """Cost of one call about one step."""
    saved: str = ""
    """Folder of it with its conformal threshold; empty where a composite policy cannot use it."""


def ranking_table(measured: Sequence[MeasuredDetector], level: float) -> Table:
    """How well scores tell frames apart, and whether they mean what they say."""
    columns = (
        Column("Detector"), Column("AUROC, failure", "percent"), Column("AP, failure", "percent"),
        Column("AUROC, deviated", "percent"), Column("AP, deviated", "percent"), Column("Brier", "ratio"),
        Column("ECE", "ratio"), Column("ms a call", "number"),
    )  # fmt: skip
    rows = []
    shares: dict[str, float] = {}
    for m in measured:
        cells: list[Cell] = [m.name]
        for label in (WILL_FAIL, DEVIATED):
            found = m.report.rankings.get(label)
            cells += [found.roc.area, found.precision_recall.area] if found else [UNDEFINED, UNDEFINED]
            if found:
                shares[label] = found.positive
        rows.append((*cells, m.report.calibrated.brier, m.report.calibrated.ece, m.cost_ms))
    base = ", ".join(f"{100 * v:.1f} % of the frames labelled `{k}`" for k, v in shares.items())
    notes = (
        f"In per cent with {100 * level:g} % intervals over scenarios (docs/statistics.md, Intervals). "
        "Failure: 1 from the recovery point on in a trial that fails, 0 in one that succeeds and in "
        "successful clean rollouts. Deviated: 1 from the recovery point on, 0 before it. A detector that "
        f"knows nothing has AUROC 50 and as AP the share of label 1: {base}. Brier and ECE are of needing "
        "help; scores that are no probabilities go through Platt's curve, fitted to the other half of the "
        "scenarios.",
    )
    return Table("detectors", "Detectors", columns, tuple(rows), notes)


def alarm_table(measured: Sequence[MeasuredDetector], alpha: float) -> Table:
    """What detectors do at their thresholds."""
    columns = (
        Column("Detector"), Column("Threshold"), Column("Clean alarmed", "percent"),
        Column("False alarms a minute", "ratio"), Column("Detected", "percent"),
        Column("of those that fail", "percent"), Column("of those that recover", "percent"),
        Column("Median delay, steps", "number"), Column("Median delay, s", "ratio"),
    )  # fmt: skip
    rows = []
    for m in measured:
        rows.append(_alarm_row(m.name, m.report.conformal))
        if m.report.own is not None:
            rows.append(_alarm_row(f"{m.name}, own decisions", m.report.own))
    first = measured[0].report.conformal
    notes = (
        f"Conformal thresholds: at most {100 * alpha:g} % of successful clean rollouts alarmed, each half of "
        "the scenarios at the threshold that the other half gives. "
        f"{first.clean} first states with a successful clean rollout, {len(first.delays)} trials from "
        "recovery points. A detector is asked from the handoff on. Delay: from the recovery point to the "
        "first alarm, among trials with one. Alarms a minute count alarms that begin, with the cluster "
        "bootstrap's percentiles.",
    )
    return Table("alarms", "Alarms", columns, tuple(rows), notes)


def _alarm_row(name: str, alarms: Alarms) -> tuple[Cell, ...]:
    steps, seconds = alarms.median_delay
    shown = " / ".join(finite(t, ".4g") for t in alarms.threshold) or "its own"
    return (
        name, shown, alarms.clean_alarmed, alarms.alarms_per_minute, alarms.detected, alarms.helped,
        alarms.needless, steps, seconds,
    )  # fmt: skip


def pair_table(found: Sequence[Contrast], level: float) -> Table:
    """Which of two detectors ranks better, adjusted.

    Args:
        found: one pair at least.
        level: confidence level of the intervals.
    """
    columns = (
        Column("A"), Column("B"), Column("AUROC, A − B", "points"), Column("p", "p"), Column("p (Holm)", "p"),
        Column("Verdict"),
    )  # fmt: skip
    rows = tuple((c.a, c.b, c.difference, c.p, c.p_holm, c.verdict.value) for c in found)
    notes = (
        f"AUROC for failure, paired over {found[0].units} scenarios by the jackknife; intervals are not "
        f"adjusted, p (Holm) is, for these {found[0].family} pairs. Verdict: p (Holm) below {1 - level:.3g}.",
    )
    return Table("pairs", "Which ranks better", columns, rows, notes)


def input_table(measured: Sequence[MeasuredDetector]) -> Table:
    columns = (Column("Detector"), Column("What"), Column("Reads"), Column("Fitted to"), Column("Saved"))
    rows = tuple((m.name, m.what, m.reads, m.fitted_to or "nothing", m.saved or "no") for m in measured)
    return Table("inputs", "What they are", columns, rows)


def write_detection_report(
    out: Path,
    measured: Sequence[MeasuredDetector],
    scored: Mapping[str, Sequence[ScoredTrial]],
    strips: Sequence[FrameStrip],
    *,
    alpha: float,
    level: float,
    seed: int,
    about: Mapping[str, Any],
    pairs: Sequence[Contrast] = (),
    against: Sequence[str] = (),
) -> Path:
    """Writes everything.

    Args:
        out: folder; files of an earlier report are overwritten.
        measured: detectors.
        scored: their scores, by name; trials in the same order.
        strips: trials to show.
        alpha: false-alarm rate of the conformal thresholds.
        level: confidence level of the intervals.
        seed: of the halves of the scenarios.
        about: what was measured: policy, scenarios, command, versions.
        pairs: of detectors, tested.
        against: names of the detectors that pairs were limited to.

    Returns:
        The page.
    """
    tables = [*_results(measured, pairs, alpha, level), input_table(measured)]
    with claim_page(out, DETECTION_FILES):
        for table in tables:
            atomic_write(out / "tables" / f"{table.name}.csv", to_csv(table))
            atomic_write(out / "tables" / f"{table.name}.tex", to_latex(table))
        atomic_write(out / "detectors.md", "\n".join(map(to_markdown, tables)))
        reports = {m.name: m.report for m in measured}
        figures = detection_figures(reports)
        strip_figures = [strip_figure(strip, scored, reports, seed) for strip in strips]
        for figure in [*figures, *strip_figures]:
            atomic_write(out / f"{figure.name}.svg", svg_of(figure.plot))
            atomic_write(out / f"{figure.name}.png", png_of(figure.plot))
        for name, trials in scored.items():
            write_scores(out / SCORES_FOLDER / f"{name}.npz", trials)
        numbers = {
            "schema_version": SCHEMA_VERSION,
            "about": dict(about),
            "alpha": alpha,
            "level": level,
            "seed": seed,
            "against": list(against),
            "detectors": {m.name: detector_json(m) for m in measured},
            "pairs": [_pair_json(c) for c in pairs],
        }
        atomic_write(out / NUMBERS_FILE, json.dumps(numbers, indent=1, default=str) + "\n")
        page = render_page(
            "detectors.html.j2", title="Detectors side by side", about=about, tables=tables,
            pictures=_pictures(figures), strips=_pictures(strip_figures),
        )  # fmt: skip
        atomic_write(out / "detectors.html", page)
        return out / "detectors.html"


def detection_text(
    measured: Sequence[MeasuredDetector], pairs: Sequence[Contrast], alpha: float, level: float
) -> str:
    """The tables for a terminal."""
    tables = _results(measured, pairs, alpha, level)
    return "\n\n".join(to_text(replace(t, notes=())) for t in tables)


def _results(
    measured: Sequence[MeasuredDetector], pairs: Sequence[Contrast], alpha: float, level: float
) -> list[Table]:
    tested = [pair_table(pairs, level)] if pairs else []
    return [ranking_table(measured, level), *tested, alarm_table(measured, alpha)]


def detector_json(m: MeasuredDetector) -> dict[str, Any]:
    """The numbers of a detector; None where one is not defined."""
    return {
        "what": m.what,
        "reads": m.reads,
        "fitted_to": m.fitted_to,
        "probabilities": m.probabilities,
        "cost_ms": round(m.cost_ms, 4),
        "conformal_threshold": _plain(m.report.threshold),
        "saved": m.saved,
        "frames": {
            label: {
                "frames": r.frames,
                "share_of_label_1": _plain(r.positive),
                "auroc": _estimate(r.roc.area),
                "average_precision": _estimate(r.precision_recall.area),
            }
            for label, r in m.report.rankings.items()
        },
        "calibration": {
            "brier": _estimate(m.report.calibrated.brier),
            "ece": _estimate(m.report.calibrated.ece),
            "confidence": [_plain(v) for v in m.report.calibrated.confidence],
            "share": [_plain(v) for v in m.report.calibrated.share],
            "frames": [int(v) for v in m.report.calibrated.frames],
        },
        "conformal": _alarms_json(m.report.conformal),
        "own_decisions": None if m.report.own is None else _alarms_json(m.report.own),
    }


def _pair_json(c: Contrast) -> dict[str, Any]:
    return {
        "a": c.a, "b": c.b, "auroc_difference": _estimate(c.difference), "p": _plain(c.p),
        "p_holm": _plain(c.p_holm), "family": c.family, "verdict": c.verdict.value,
    }  # fmt: skip


def _alarms_json(alarms: Alarms) -> dict[str, Any]:
    steps, seconds = alarms.median_delay
    return {
        "thresholds": [_plain(t) for t in alarms.threshold],
        "clean_rollouts": alarms.clean,
        "clean_alarmed": _estimate(alarms.clean_alarmed),
        "false_alarms_per_minute": _estimate(alarms.alarms_per_minute),
        "detected": _estimate(alarms.detected),
        "detected_of_those_that_fail": _estimate(alarms.helped),
        "detected_of_those_that_recover": _estimate(alarms.needless),
        "median_delay_steps": _plain(steps),
        "median_delay_s": _plain(seconds),
        "delays_steps": [_plain(v) for v in alarms.delays],
    }


def _estimate(value: Estimate) -> dict[str, float | None]:
    return {k: _plain(v) for k, v in asdict(value).items()}


def _plain(value: float) -> float | None:
    return round(float(value), 6) if math.isfinite(value) else None


def _pictures(figures: Sequence[Figure]) -> list[dict[str, str]]:
    return [picture(figure) for figure in figures]
