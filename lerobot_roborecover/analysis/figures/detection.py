"""Curves of detectors side by side, and the moments at which they fire on a frame strips."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.figures import style
from lerobot_roborecover.analysis.stats.detection import WILL_FAIL, DetectionReport, Ranking, ScoredTrial
from lerobot_roborecover.analysis.stats.monitor_curves import Curve

type Reports = Mapping[str, DetectionReport]
"""By detector."""


@dataclass(frozen=True)
class FrameStrip:
    """Pictures of one trial."""

    trial: int
    """Its number among the trials."""
    steps: tuple[int, ...]
    """Steps of the pictures, replayed ones counted."""
    pictures: tuple[np.ndarray, ...]
    """(H, W, 3) uint8, one a step; none where they could not be rendered."""


def detection_figures(reports: Reports) -> list[style.Figure]:
    """ROC, precision and recall, delays, reliability."""
    return [_roc(reports), _precision(reports), _delays(reports), _reliability(reports)]


def _roc(reports: Reports) -> style.Figure:
    with style.drawing() as subplots:
        plot, axes = subplots(5.2, 4.6)
        words = _ranked(axes, reports, lambda ranking: ranking.roc)
        axes.plot([0, 1], [0, 1], ":", color=style.SOFT, lw=1)
        axes.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel="false-positive rate", ylabel="recall")
        _finish(axes, "lower right")
    return style.Figure("detectors_roc", "Failure label: ROC, with the area", words, plot)


def _precision(reports: Reports) -> style.Figure:
    with style.drawing() as subplots:
        plot, axes = subplots(5.2, 4.6)
        words = _ranked(axes, reports, lambda ranking: ranking.precision_recall)
        for report in reports.values():
            if WILL_FAIL in report.rankings:
                axes.axhline(report.rankings[WILL_FAIL].positive, color=style.SOFT, ls=":", lw=1)
        axes.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel="recall", ylabel="precision")
        _finish(axes, "lower left")
    title = "Failure label: precision and recall, with the area; dotted: share of frames"
    return style.Figure("detectors_precision_recall", title, words, plot)


def _ranked(axes: Any, reports: Reports, curve_of: Callable[[Ranking], Curve]) -> str:
    """One curve a detector that ranks at all, each with its area; the same in words."""
    words = []
    for i, (name, report) in enumerate(reports.items()):
        if WILL_FAIL not in report.rankings:
            continue
        curve = curve_of(report.rankings[WILL_FAIL])
        area = style.number(curve.area.value, ".2f")
        axes.plot(
            curve.x,
            curve.y,
            style.dash(i),
            color=style.colour(i),
            lw=1.6,
            label=f"{style.short(name, 22)} {area}",
        )
        words.append(f"{name} {area}")
    return "; ".join(words)


def _delays(reports: Reports) -> style.Figure:
    with style.drawing() as subplots:
        plot, axes = subplots(5.2, 4.6)
        words = []
        for i, (name, report) in enumerate(reports.items()):
            every = report.conformal.delays_s
            delays = np.sort(every[np.isfinite(every)])
            share = np.arange(1, len(delays) + 1) / max(len(every), 1)
            axes.step(
                np.insert(delays, 0, 0), np.insert(share, 0, 0), style.dash(i), where="post",
                color=style.colour(i),
                lw=1.6, label=style.short(name, 22),
            )  # fmt: skip
            words.append(f"{name}: {style.number(100 * report.conformal.detected.value)} %")
        axes.set(ylim=(0, 1.01), xlabel="seconds since the recovery point", ylabel="share of trials alarmed")
        _finish(axes, "lower right")
    return style.Figure("detectors_delays", "Alarms after the recovery point, conformal thresholds",
                  "; ".join(words), plot)  # fmt: skip


def _reliability(reports: Reports) -> style.Figure:
    with style.drawing() as subplots:
        plot, axes = subplots(5.2, 4.6)
        words = []
        for i, (name, report) in enumerate(reports.items()):
            found = report.calibrated
            there = found.frames > 0
            axes.plot(
                found.confidence[there], found.share[there], style.dash(i), marker=style.marker(i), ms=4,
                color=style.colour(i),
                lw=1.4, label=f"{style.short(name, 22)} {style.number(found.ece.value, '.2f')}",
            )  # fmt: skip
            words.append(f"{name}: ECE {style.number(found.ece.value, '.2f')}")
        axes.plot([0, 1], [0, 1], ":", color=style.SOFT, lw=1)
        axes.set(xlim=(0, 1.01), ylim=(0, 1.01), xlabel="probability said", ylabel="share that fails")
        _finish(axes, "upper left")
    return style.Figure(
        "detectors_reliability", "Reliability, with the calibration error", "; ".join(words), plot
    )


def _finish(axes, place: str) -> None:
    axes.grid(color=style.LINE, lw=0.6)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc=place, fontsize=8)


def strip_figure(
    strip: FrameStrip, scored: Mapping[str, Sequence[ScoredTrial]], reports: Reports, seed: int
) -> style.Figure:
    """One trial: pictures above, each detector's score below, alarms marked.

    Args:
        strip: its pictures.
        scored: by detector, all trials.
        reports: by detector, for their thresholds.
        seed: of the halves of the scenarios.
    """
    one = next(iter(scored.values()))[strip.trial]
    thresholds = {
        name: _threshold(scored[name], report, strip.trial, seed) for name, report in reports.items()
    }
    firsts = {
        name: one.handoff + int(hits[0])
        for name in reports
        if len(hits := np.flatnonzero(scored[name][strip.trial].after > thresholds[name]))
    }
    kind = "from its recovery point" if one.start == "recovery" else "from its first state"
    ends = "succeeds" if one.success else "fails"
    title = f"{one.scenario}, {kind}: {ends}; a mark is the first alarm at the conformal threshold"
    words = [f"{n}: first alarm at step {s - one.handoff} after the handoff" for n, s in firsts.items()]
    wide, narrow = style.both(lambda width: _draw_strip(width, strip, scored, reports, one, firsts))
    return style.Figure(
        f"frames_{strip.trial}", title, "; ".join(words) or "no detector alarms", wide, narrow
    )


def _threshold(trials: Sequence[ScoredTrial], report: DetectionReport, trial: int, seed: int) -> float:
    from lerobot_roborecover.analysis.stats.conformal import halves

    half = halves(np.array([t.unit for t in trials]), seed)
    return report.conformal.threshold[half[trial]]


def _draw_strip(
    width: style.Width,
    strip: FrameStrip,
    scored: Mapping,
    reports: Reports,
    one: ScoredTrial,
    firsts: Mapping,
) -> style.Plot:
    names = list(reports)
    keep = range(len(strip.pictures)) if not width.narrow else range(0, len(strip.pictures), 2)
    with style.drawing() as subplots:
        tall = 1.25 if strip.pictures else 0.1
        plot, rows = subplots(
            width.inches, tall + 0.42 * len(names) + 0.5, nrows=len(names) + 1,
            gridspec_kw={"height_ratios": [tall, *[0.42] * len(names)]},
        )  # fmt: skip
        rows[0].axis("off")
        first, last = min((*strip.steps, one.handoff)), len(one.scores) - 1
        for place, at in enumerate(keep):
            left = place / len(keep)
            inset = rows[0].inset_axes((left, 0.0, 0.97 / len(keep), 0.9))
            inset.imshow(strip.pictures[at])
            inset.set(xticks=[], yticks=[])
            inset.set_title(f"{strip.steps[at] - one.handoff:+d}", fontsize=8, pad=2)
        for i, name in enumerate(names):
            axes = rows[i + 1]
            steps = np.arange(first, last + 1) - one.handoff
            axes.plot(steps, scored[name][strip.trial].scores[first:], color=style.colour(i), lw=1.2)
            axes.axvline(0, color=style.INK, lw=0.8)
            if name in firsts:
                axes.axvline(firsts[name] - one.handoff, color=style.colour(i), lw=2.2, ls=":")
            axes.set_yticks([])
            axes.set_xlim(first - one.handoff, max(last - one.handoff, 1))
            axes.annotate(
                style.short(name, 24), (0, 1), (2, -2), xycoords="axes fraction", textcoords="offset points",
                va="top", fontsize=8,
            )  # fmt: skip
            if i + 1 < len(names):
                axes.set_xticks([])
        rows[-1].set_xlabel("steps since the handoff")
    return plot


def finite(value: float, spec: str) -> str:
    """A threshold in words: `none` where it is infinite."""
    return "none" if math.isinf(value) else format(value, spec)
