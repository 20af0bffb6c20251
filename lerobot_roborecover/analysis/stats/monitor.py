"""Metrics of a recovery monitor; label 1 is "deviated". Frames come from a dataset with labels, episodes from
their order; intervals take scenarios as independent, because frames of one scenario look alike."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import LEVEL, Estimate
from lerobot_roborecover.analysis.stats.resampling import resample

METRICS = ("accuracy", "precision", "recall", "f1", "macro_f1", "false_positive_rate")
"""The paper's (appendix, "Monitor Training and Triggering"), all in [0, 1]."""


@dataclass(frozen=True)
class MonitorFrames:
    """What a monitor said of N labelled frames; arrays of length N."""

    scenario: np.ndarray
    """Scenario ids: the unit of resampling."""
    episode: np.ndarray
    """int64: trajectory of the frame."""
    step: np.ndarray
    """int64: environment step since the task's reset."""
    label: np.ndarray
    """int64: 0 before the recovery point, 1 from it on."""
    score: np.ndarray
    """float64 in [0, 1]; NaN where the answer could not be read."""
    decision: np.ndarray
    """bool: the monitor would trigger; never for an answer that could not be read."""
    recovery_step: np.ndarray
    """int64: first step of label 1 in the frame's trajectory, whether that frame is there or not."""

    def __post_init__(self):
        lengths = {len(getattr(self, f.name)) for f in fields(self)}
        if len(lengths) != 1 or not lengths.pop():
            raise ValueError("monitor frames need equally long columns, and at least one frame")

    @property
    def parsed(self) -> np.ndarray:
        """(N,) bool: the answer could be read."""
        return ~np.isnan(self.score)

    def at(self, threshold: float) -> MonitorFrames:
        """The same frames, decided by score > threshold."""
        decision = np.where(self.parsed, self.score > threshold, False)
        return MonitorFrames(**{**vars(self), "decision": decision})


@dataclass(frozen=True)
class EpisodeMetrics:
    """What a monitor does to whole trajectories, watched from the recovery point on (paper: it is not asked
    before, and once it has triggered it is not asked again)."""

    trajectories: int
    trigger_rate: Estimate
    """Share of trajectories with a trigger at or after the recovery point."""
    early_rate: Estimate
    """Share with a decision 1 before the recovery point: false alarms, had it been asked there."""
    delay_mean: Estimate
    """Steps from the recovery point to the first trigger, among those that trigger."""
    delays: np.ndarray
    """(trajectories,) float64 of those steps; NaN where nothing triggers."""
    every_step: bool
    """All steps from the recovery point on are there; otherwise delays are too long and rates too low."""


def confusion_by_scenario(frames: MonitorFrames, row: np.ndarray, count: int) -> np.ndarray:
    """(scenarios, 4) TN, FP, FN, TP."""
    kind = 2 * frames.label + frames.decision.astype(np.int64)
    return np.stack([np.bincount(row[kind == k], minlength=count) for k in range(4)], axis=1).astype(float)


def metric_columns(counts: np.ndarray) -> np.ndarray:
    """(n, 6) metrics of (n, 4) confusion counts, in the order of `METRICS`; NaN where not defined."""
    tn, fp, fn, tp = counts.T

    def ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
        return np.divide(top, bottom, out=np.full(len(top), np.nan), where=bottom > 0)

    f1, f0 = ratio(2 * tp, 2 * tp + fp + fn), ratio(2 * tn, 2 * tn + fp + fn)
    columns = {
        "accuracy": ratio(tn + tp, tn + fp + fn + tp),
        "precision": ratio(tp, tp + fp),
        "recall": ratio(tp, tp + fn),
        "f1": f1,
        "macro_f1": (f1 + f0) / 2,
        "false_positive_rate": ratio(fp, fp + tn),
    }
    return np.stack([columns[name] for name in METRICS], axis=1)


def metric_weights(counts: np.ndarray) -> np.ndarray:
    """(n, 6) frames that each metric looks at, of (n, 4) confusion counts by scenario: F1 looks twice at
    hits; of the two halves of Macro-F1, the one that rests on fewer scenarios."""
    tn, fp, fn, tp = counts.T
    f1, f0 = 2 * tp + fp + fn, 2 * tn + fp + fn
    columns = {
        "accuracy": counts.sum(1),
        "precision": tp + fp,
        "recall": tp + fn,
        "f1": f1,
        "macro_f1": fewer(f1, f0),
        "false_positive_rate": fp + tn,
    }
    return np.stack([columns[name] for name in METRICS], axis=1)


def fewer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of two (n,) weights, the one under which fewer of the n count."""

    def effective(w: np.ndarray) -> float:
        return float(w.sum() ** 2 / (w**2).sum()) if w.any() else 0.0

    return a if effective(a) < effective(b) else b


def episode_metrics(frames: MonitorFrames, level: float = LEVEL) -> EpisodeMetrics:
    """Triggers and delays by trajectory.

    Args:
        frames: labelled and judged.
        level: confidence level.
    """
    episodes, first = np.unique(frames.episode, return_index=True)
    sampling = resample(frames.scenario[first], level=level)
    delays, early, complete = np.full(len(episodes), np.nan), np.zeros(len(episodes)), True
    for number, episode in enumerate(episodes):
        mine = frames.episode == episode
        step, decision = frames.step[mine], frames.decision[mine]
        after = step >= frames.recovery_step[mine]
        early[number] = float((decision & ~after).any())
        hits = step[decision & after]
        start = frames.recovery_step[mine][0]
        if len(hits):
            delays[number] = hits.min() - start
        watched = np.sort(step[after])
        complete &= len(watched) > 0 and watched[0] == start and bool((np.diff(watched) == 1).all())
    triggered = np.isfinite(delays)

    # Delays lie between none and the longest that could be seen: few equal ones must not look sure.
    most = max(float((frames.step - frames.recovery_step).max()), 1.0)
    trigger_rate, early_rate, share = sampling.rates(np.stack([triggered, early, delays / most], 1))
    return EpisodeMetrics(
        trajectories=len(episodes),
        trigger_rate=trigger_rate,
        early_rate=early_rate,
        delay_mean=Estimate(*(most * v for v in (share.value, share.low, share.high))),
        delays=delays,
        every_step=complete,
    )
