"""A monitor's precision-recall and ROC curves, intervals of their areas, and the choice of a threshold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    Estimate,
    estimate_of,
    jackknife,
    rate_interval,
)
from lerobot_roborecover.analysis.stats.monitor import METRICS, MonitorFrames, fewer, metric_columns


@dataclass(frozen=True)
class Curve:
    """A curve over thresholds, from the highest to the lowest, and the area under it."""

    x: np.ndarray
    y: np.ndarray
    thresholds: np.ndarray
    area: Estimate
    left_out: np.ndarray
    """(scenarios,) the area with each of them left out in turn."""
    weights: np.ndarray
    """(scenarios,) their frames on the curve."""


def _ordered(frames: MonitorFrames, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Readable frames from the highest score to the lowest: scores, labels, scenario rows, and where a
    threshold can lie (the last frame of each score)."""
    keep = np.flatnonzero(frames.parsed)
    order = keep[np.argsort(-frames.score[keep], kind="stable")]
    score = frames.score[order]
    last = np.flatnonzero(np.append(np.diff(score) != 0, True)) if len(score) else np.zeros(0, np.int64)
    return score, frames.label[order], row[order], last


def precision_recall(frames: MonitorFrames, row: np.ndarray, level: float = LEVEL) -> Curve:
    """Precision over recall; the area is the average precision (no interpolation).

    Args:
        frames: labelled and judged.
        row: (N,) scenario of each frame, counted from zero.
        level: confidence level of the area.
    """
    score, label, rows, last = _ordered(frames, row)
    count = int(row.max()) + 1
    # Frames whose answer cannot be read never trigger; those of label 1 are missed at every threshold.
    missed = np.bincount(row[~frames.parsed & (frames.label == 1)], minlength=count)
    deviated = np.bincount(row[frames.label == 1], minlength=count)

    def curve(counted: np.ndarray, lost: float) -> tuple[np.ndarray, np.ndarray]:
        hits, flagged = np.cumsum(counted * label)[last], np.cumsum(counted)[last]
        everything = (hits[-1] if len(hits) else 0.0) + lost
        recall = hits / everything if everything else np.full(len(hits), np.nan)
        return recall, np.divide(hits, flagged, out=np.ones(len(hits)), where=flagged > 0)

    def average_precision(recall: np.ndarray, precision: np.ndarray) -> float:
        return float(np.sum(np.diff(recall, prepend=0.0) * precision)) if len(recall) else np.nan

    recall, precision = curve(np.ones(len(rows)), float(missed.sum()))
    left_out = [average_precision(*curve(rows != i, float(missed.sum() - missed[i]))) for i in range(count)]
    area = _area(average_precision(recall, precision), left_out, deviated, level)
    return Curve(
        recall, precision, score[last], area, np.array(left_out, float), np.bincount(row, minlength=count)
    )


def roc(frames: MonitorFrames, row: np.ndarray, level: float = LEVEL) -> Curve:
    """Recall over false-positive rate, among the answers that can be read; arguments as above."""
    score, label, rows, last = _ordered(frames, row)
    count = int(row.max()) + 1

    def curve(counted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits, alarms = np.cumsum(counted * label)[last], np.cumsum(counted * (1 - label))[last]
        rates = []
        for counts in (alarms, hits):
            total = counts[-1] if len(counts) else 0.0
            rates.append(np.insert(counts / total if total else np.full(len(counts), np.nan), 0, 0.0))
        return rates[0], rates[1]

    def under(x: np.ndarray, y: np.ndarray) -> float:
        return float(np.trapezoid(y, x)) if len(x) > 1 else np.nan  # no answer, no curve

    x, y = curve(np.ones(len(rows)))
    left_out = [under(*curve(rows != i)) for i in range(count)]
    by_label = [np.bincount(rows[label == one], minlength=count) for one in (0, 1)]
    area = _area(under(x, y), left_out, fewer(*by_label), level)
    thresholds = np.insert(score[last], 0, np.inf)
    return Curve(x, y, thresholds, area, np.array(left_out, float), by_label[0] + by_label[1])


def _area(value: float, left_out: list[float], weights: np.ndarray, level: float) -> Estimate:
    return estimate_of(value, rate_interval(jackknife(value, np.array(left_out, float), weights), level))


RULES = ("macro_f1", "f1", "accuracy", "youden")
"""Rules of `choose_threshold`, beside `fpr=LIMIT`."""


def choose_threshold(frames: MonitorFrames, rule: str) -> float:
    """The score above which to trigger; beyond the paper, whose monitor answers 0 or 1.

    Args:
        frames: of a validation set that results are not reported on.
        rule: what is largest at the threshold: `macro_f1`, `f1`, `accuracy`, `youden` (recall minus
            false-positive rate); or `fpr=0.05`: the lowest threshold with at most that false-positive rate.

    Returns:
        A score halfway between two that occur, so that neither rounding nor ties decide.

    Raises:
        ValueError: there is no such rule, or no frame of one label.
    """
    name, _, limit = rule.partition("=")
    if (name not in RULES or limit) and not (name == "fpr" and _is_rate(limit)):
        raise ValueError(f"threshold rule {rule!r} is not one of {', '.join(RULES)} or fpr=0.05")
    score, label, _, last = _ordered(frames, np.zeros(len(frames.label), np.int64))
    ones, zeros = int((frames.label == 1).sum()), int((frames.label == 0).sum())
    if not len(score) or not ones or not zeros:
        raise ValueError("a threshold needs readable frames of both labels")
    tp, fp = np.cumsum(label)[last], np.cumsum(1 - label)[last]
    tp, fp = np.insert(tp, 0, 0), np.insert(fp, 0, 0)
    highest = np.insert(score[last], 0, 1.0)
    columns = metric_columns(np.stack([zeros - fp, fp, ones - tp, tp], axis=1).astype(float))
    if name == "fpr":
        best = int(np.flatnonzero(fp / zeros <= float(limit))[-1])
    elif name == "youden":
        best = int(np.argmax(tp / ones - fp / zeros))
    else:
        best = int(np.nanargmax(columns[:, METRICS.index(name)]))
    below = highest[best + 1] if best + 1 < len(highest) else 0.0
    return float((highest[best] + below) / 2)


def _is_rate(text: str) -> bool:
    try:
        return 0.0 <= float(text) <= 1.0
    except ValueError:
        return False
