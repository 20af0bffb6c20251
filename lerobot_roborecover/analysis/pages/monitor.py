"""A monitor's measurement on disk: tables, curves, figures, and one page that holds them all."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.escape import csv_text
from lerobot_roborecover.analysis.figures.style import (
    INK,
    LINE,
    SOFT,
    Figure,
    colour,
    dash,
    drawing,
    number,
    png_of,
    short,
    svg_of,
)
from lerobot_roborecover.analysis.pages.page import picture, render_page
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.monitor import METRICS, MonitorFrames
from lerobot_roborecover.analysis.stats.monitor_curves import Curve
from lerobot_roborecover.analysis.stats.monitor_report import MonitorReport
from lerobot_roborecover.analysis.tables import Column, Table, to_csv, to_latex, to_markdown, to_text
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import claim_page

TITLES = {
    "accuracy": "Acc.",
    "precision": "Prec.",
    "recall": "Recall",
    "f1": "F1",
    "macro_f1": "Macro-F1",
    "false_positive_rate": "FPR",
}
MONITOR_FILES = ("monitor.html", "monitor.md", "metrics.json", "tables", "frames", "curves")
_CSV_POINTS = 2000
"""Most points of a curve in its CSV."""


@dataclass(frozen=True)
class Measured:
    """One monitor on one dataset."""

    name: str
    """Name of the dataset."""
    frames: MonitorFrames
    report: MonitorReport


def metrics_table(measured: Sequence[Measured], level: float) -> Table:
    """Per-frame metrics, as in the paper's Table of monitor validation results."""
    columns = (Column("Validation"), *(Column(TITLES[m], "percent") for m in METRICS))
    rows = tuple((m.name, *(m.report.metrics[k] for k in METRICS)) for m in measured)
    note = (
        f"In per cent with {100 * level:g} % intervals over scenarios (docs/statistics.md, Intervals). "
        "Precision, recall and F1 are of label 1."
    )
    return Table("metrics", "Frames", columns, rows, (note,))


def confusion_table(measured: Sequence[Measured]) -> Table:
    """Confusion counts and answers that could not be read."""
    titles = ("Scenarios", "Frames", "TN", "FP", "FN", "TP", "Unparsed")
    columns = (Column("Validation"), *(Column(t, "count") for t in titles))
    rows = tuple(
        (m.name, m.report.scenarios, m.report.frames, *m.report.confusion, m.report.unparsed)
        for m in measured
    )
    note = "An answer that cannot be read does not trigger: it counts as 0 in TN and FN, and in Unparsed."
    return Table("confusion", "Confusion counts", columns, rows, (note,))


def episode_table(measured: Sequence[Measured]) -> Table:
    """What the monitor does to whole trajectories."""
    columns = (
        Column("Validation"), Column("Trajectories", "count"), Column("Trigger rate", "percent"),
        Column("Flagged before", "percent"), Column("Mean delay", "number"), Column("Median delay", "number"),
        Column("AP", "percent"), Column("AUROC", "percent"),
    )  # fmt: skip
    rows = []
    notes = [
        "Trigger rate: trajectories with a 1 at or after the recovery point. Flagged before: with a 1 before "
        "it, where the monitor is not asked in use. Delay: steps from the recovery point to the first 1, "
        "among those that trigger. AP and AUROC: areas under the precision-recall and ROC curves."
    ]
    for m in measured:
        e = m.report.episodes
        hit = e.delays[np.isfinite(e.delays)]
        median = float(np.median(hit)) if len(hit) else math.nan
        curves = (m.report.precision_recall.area, m.report.roc.area)
        rows.append((m.name, e.trajectories, e.trigger_rate, e.early_rate, e.delay_mean, median, *curves))
        if not e.every_step:
            notes.append(
                f"{m.name} leaves out steps: trigger rates are too low and delays too long there. Make every "
                "step with `roborecover detect data` without --natural-frames and --stride."
            )
    return Table("episodes", "Trajectories", columns, tuple(rows), tuple(notes))


def figures(measured: Sequence[Measured]) -> list[Figure]:
    """Precision-recall and ROC curves, delays, and scores around the recovery point."""
    return [
        _curves(measured, "precision_recall", "Precision and recall", "recall", "precision", "AP"),
        _curves(measured, "roc", "ROC", "false-positive rate", "recall", "AUROC"),
        _delays(measured),
        _scores(measured),
    ]


def _curves(measured: Sequence[Measured], name: str, title: str, x: str, y: str, area: str) -> Figure:
    with drawing() as subplots:
        plot, axes = subplots(5.2, 4.2)
        words = []
        for i, m in enumerate(measured):
            curve: Curve = getattr(m.report, name)
            label = f"{short(m.name)} ({area} {number(curve.area.value, '.3f')})"
            axes.plot(curve.x, curve.y, dash(i), color=colour(i), label=label, lw=1.6)
            at = m.report.metrics
            point = (
                (at["recall"], at["precision"])
                if name != "roc"
                else (at["false_positive_rate"], at["recall"])
            )
            axes.plot(point[0].value, point[1].value, "o", color=colour(i), ms=6)
            words.append(f"{m.name}: {area} {number(curve.area.value, '.3f')}")
        if name == "roc":
            axes.plot([0, 1], [0, 1], ":", color=SOFT, lw=1)
        axes.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel=x, ylabel=y)
        axes.grid(color=LINE, lw=0.6)
        axes.legend(loc="lower right" if name == "roc" else "lower left", fontsize=8)
    return Figure(name, f"{title}; the dot is the monitor's own decision", "; ".join(words), plot)


def _delays(measured: Sequence[Measured]) -> Figure:
    with drawing() as subplots:
        plot, axes = subplots(5.2, 4.2)
        words = []
        for i, m in enumerate(measured):
            delays = np.sort(m.report.episodes.delays[np.isfinite(m.report.episodes.delays)])
            share = np.arange(1, len(delays) + 1) / max(len(m.report.episodes.delays), 1)
            axes.step(np.insert(delays, 0, 0), np.insert(share, 0, 0), dash(i), where="post", color=colour(i),
                      label=short(m.name), lw=1.6)  # fmt: skip
            words.append(f"{m.name}: {number(100 * m.report.episodes.trigger_rate.value)} % trigger")
        axes.set(
            ylim=(0, 1.01), xlabel="steps since the recovery point", ylabel="share of trajectories triggered"
        )
        axes.grid(color=LINE, lw=0.6)
        axes.legend(loc="lower right", fontsize=8)
    return Figure("delays", "Triggers after the recovery point", "; ".join(words), plot)


def _scores(measured: Sequence[Measured], reach: int = 100, width: int = 10) -> Figure:
    """Mean score by distance from the recovery point, in bins of `width` steps."""
    edges = np.arange(-reach, reach + 1, width)
    with drawing() as subplots:
        plot, axes = subplots(5.2, 4.2)
        for i, m in enumerate(measured):
            since = m.frames.step - m.frames.recovery_step
            keep = m.frames.parsed & (since >= -reach) & (since < reach)
            where = np.digitize(since[keep], edges) - 1
            sums = np.bincount(where, m.frames.score[keep], len(edges) - 1)
            mass = np.bincount(where, minlength=len(edges) - 1)
            mean = np.divide(sums, mass, out=np.full(len(mass), np.nan), where=mass > 0)
            axes.plot(edges[:-1] + width / 2, mean, dash(i), color=colour(i), label=short(m.name), lw=1.6)
        axes.axvline(0, color=INK, lw=0.8)
        axes.set(ylim=(0, 1.01), xlabel="steps since the recovery point", ylabel="mean score")
        axes.grid(color=LINE, lw=0.6)
        axes.legend(loc="lower right", fontsize=8)
    return Figure(
        "scores", "Score around the recovery point", "Mean score by distance from the recovery point.", plot
    )


def write_monitor_report(
    out: Path, measured: Sequence[Measured], *, level: float, about: Mapping[str, Any]
) -> Path:
    """Writes everything.

    Args:
        out: folder; files of an earlier report are overwritten.
        measured: per dataset.
        level: confidence level of the intervals.
        about: what was measured: monitor, threshold, command, versions.

    Returns:
        The page.
    """
    tables = [metrics_table(measured, level), confusion_table(measured), episode_table(measured)]
    with claim_page(out, MONITOR_FILES):
        for table in tables:
            atomic_write(out / "tables" / f"{table.name}.csv", to_csv(table))
            atomic_write(out / "tables" / f"{table.name}.tex", to_latex(table))
        atomic_write(out / "monitor.md", "\n".join(map(to_markdown, tables)))
        pictures = []
        for figure in figures(measured):
            atomic_write(out / f"{figure.name}.svg", svg_of(figure.plot))
            atomic_write(out / f"{figure.name}.png", png_of(figure.plot))
            pictures.append(picture(figure))
        for m in measured:
            _write_frames(out / "frames" / f"{m.name}.csv", m.frames)
            for name in ("precision_recall", "roc"):
                _write_curve(out / "curves" / f"{m.name}_{name}.csv", getattr(m.report, name), name)
        numbers = {
            "about": dict(about),
            "level": level,
            "datasets": {m.name: to_json(m.report) for m in measured},
        }
        atomic_write(out / "metrics.json", json.dumps(numbers, indent=1, default=str) + "\n")
        page = render_page(
            "tables_figures.html.j2", title="Recovery monitor", about=about, pictures=pictures, tables=tables
        )
        atomic_write(out / "monitor.html", page)
        return out / "monitor.html"


def to_json(report: MonitorReport) -> dict[str, Any]:
    """The numbers of a report; None where one is not defined."""

    def plain(value: Estimate) -> dict[str, float | None]:
        return {k: None if math.isnan(v) else round(v, 6) for k, v in asdict(value).items()}

    e = report.episodes
    return {
        "frames": report.frames,
        "scenarios": report.scenarios,
        "confusion": dict(zip(("tn", "fp", "fn", "tp"), report.confusion, strict=True)),
        "unparsed": report.unparsed,
        "metrics": {name: plain(value) for name, value in report.metrics.items()},
        "average_precision": plain(report.precision_recall.area),
        "auroc": plain(report.roc.area),
        "episodes": {
            "trajectories": e.trajectories,
            "every_step": e.every_step,
            "trigger_rate": plain(e.trigger_rate),
            "early_rate": plain(e.early_rate),
            "delay_mean": plain(e.delay_mean),
            "delays": [None if math.isnan(d) else int(d) for d in e.delays],
        },
    }


def summary_text(measured: Sequence[Measured], level: float) -> str:
    """The tables for a terminal."""
    plain = [
        replace(t, notes=())
        for t in (metrics_table(measured, level), confusion_table(measured), episode_table(measured))
    ]
    return "\n\n".join(to_text(t) for t in plain)


def _write_frames(path: Path, frames: MonitorFrames) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ("scenario", "episode", "step", "recovery_step", "label", "score", "decision")
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for scenario, episode, step, start, label, score, decision in zip(
            *(getattr(frames, n) for n in names), strict=True
        ):
            shown = "" if math.isnan(score) else f"{score:.6g}"
            writer.writerow([csv_text(str(scenario)), episode, step, start, label, shown, int(decision)])


def _write_curve(path: Path, curve: Curve, name: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    heads = ("recall", "precision") if name == "precision_recall" else ("false_positive_rate", "recall")
    keep = np.unique(np.linspace(0, len(curve.x) - 1, min(len(curve.x), _CSV_POINTS)).round().astype(int))
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["threshold", *heads])
        for i in keep:
            writer.writerow([f"{curve.thresholds[i]:.6g}", f"{curve.x[i]:.6g}", f"{curve.y[i]:.6g}"])
