"""Everything that is measured of one monitor on one dataset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    Estimate,
    estimates_of,
    jackknife,
    rate_interval,
)
from lerobot_roborecover.analysis.stats.monitor import (
    METRICS,
    EpisodeMetrics,
    MonitorFrames,
    confusion_by_scenario,
    episode_metrics,
    metric_columns,
    metric_weights,
)
from lerobot_roborecover.analysis.stats.monitor_curves import Curve, precision_recall, roc


@dataclass(frozen=True)
class MonitorReport:
    """Everything about one monitor on one dataset."""

    frames: int
    scenarios: int
    confusion: tuple[int, int, int, int]
    """TN, FP, FN, TP."""
    unparsed: int
    metrics: dict[str, Estimate]
    """Metrics by the names of `METRICS`."""
    episodes: EpisodeMetrics
    precision_recall: Curve
    """x recall, y precision; the area is the average precision."""
    roc: Curve
    """x false-positive rate, y recall."""


def monitor_report(frames: MonitorFrames, *, level: float = LEVEL) -> MonitorReport:
    """All numbers with intervals over scenarios.

    Args:
        frames: labelled and judged.
        level: confidence level.
    """
    ids, row = np.unique(frames.scenario, return_inverse=True)
    counts = confusion_by_scenario(frames, row, len(ids))
    tn, fp, fn, tp = (int(v) for v in counts.sum(0))
    return MonitorReport(
        frames=len(frames.label),
        scenarios=len(ids),
        confusion=(tn, fp, fn, tp),
        unparsed=int((~frames.parsed).sum()),
        metrics=metric_estimates(counts, level),
        episodes=episode_metrics(frames, level),
        precision_recall=precision_recall(frames, row, level),
        roc=roc(frames, row, level),
    )


def metric_estimates(counts: np.ndarray, level: float = LEVEL) -> dict[str, Estimate]:
    """The metrics by name, with intervals over scenarios.

    Args:
        counts: (scenarios, 4) TN, FP, FN, TP.
        level: confidence level.
    """
    total = counts.sum(0)
    (point,), left_out = metric_columns(total[None]), metric_columns(total - counts)
    bounds = rate_interval(jackknife(point, left_out.T, metric_weights(counts).T), level)
    return dict(zip(METRICS, estimates_of(point, bounds), strict=True))
