"""Evaluates a detector on whole trials: which trials it flags, how early, and what false alarms cost.

A frame has two labels. `deviated` is the paper's: 0 before the recovery point, 1 from it on. `WILL_FAIL` is
the failure label: whether the acting policy fails to recover by itself.

- Frames from the recovery point on: 1 in a trial that fails, 0 in a trial that succeeds.
- Frames of successful clean rollouts: 0.
- Frames before the recovery point: no label, because the policy did not act there.
- Frames of clean rollouts that fail: no label, because the step at which they go wrong is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.calibration import Calibration, as_probability, calibration, platt
from lerobot_roborecover.analysis.stats.conformal import conformal_threshold, halves
from lerobot_roborecover.analysis.stats.intervals import LEVEL, UNDEFINED, Estimate
from lerobot_roborecover.analysis.stats.monitor import MonitorFrames
from lerobot_roborecover.analysis.stats.monitor_curves import Curve, precision_recall, roc
from lerobot_roborecover.analysis.stats.resampling import resample

DEVIATED, WILL_FAIL = "deviated", "needs help"
_MINUTE_S = 60.0


@dataclass(frozen=True)
class ScoredTrial:
    """One trial, and what a detector said at each step. Apart from `TrialRow`, which no detector has seen."""

    scenario: str
    unit: str
    """Label of what is independent: the first state, which scenarios share that branch off from it."""
    start: str
    """`recovery`, or `initial`: a clean rollout."""
    trial: int
    success: bool
    control_hz: float
    handoff: int
    """Steps before the policy took over, replayed; in a clean rollout none is looked at."""
    scores: np.ndarray
    """(T,) float64, of each step's observation, replayed ones first; NaN where it said nothing."""
    decisions: np.ndarray
    """(T,) bool: alarms at its own threshold; all False where it has none."""

    @property
    def clean(self) -> bool:
        """A clean rollout that succeeds: every alarm in it is a false one."""
        return self.start == "initial" and self.success

    @property
    def after(self) -> np.ndarray:
        """(T - handoff,) scores from the handoff on."""
        return self.scores[self.handoff :]

    @property
    def highest(self) -> float:
        """Highest score from the handoff on; NaN where it said nothing."""
        known = self.after[~np.isnan(self.after)]
        return float(known.max()) if len(known) else math.nan


@dataclass(frozen=True)
class Ranking:
    """How well scores tell a label's frames apart, whatever the threshold."""

    frames: int
    positive: float
    """Share of label 1, which is the average precision of a detector that knows nothing."""
    roc: Curve
    precision_recall: Curve


@dataclass(frozen=True)
class Alarms:
    """What a detector does at a threshold, asked from the handoff on."""

    threshold: tuple[float, ...]
    """Threshold of either half of the scenarios; empty for the detector's own decisions."""
    clean: int
    """First states with a successful clean rollout."""
    clean_alarmed: Estimate
    """Share of clean rollouts with an alarm, each first state weighing the same: what the conformal threshold
    holds down."""
    alarms_per_minute: Estimate
    """Alarms that begin in them, a minute of robot time."""
    detected: Estimate
    """Share of trials from recovery points with an alarm."""
    helped: Estimate
    """The same of those that fail without help."""
    needless: Estimate
    """The same of those that recover by themselves."""
    delays: np.ndarray
    """(trials from recovery points,) steps from the recovery point to the first alarm; NaN without one."""
    delays_s: np.ndarray
    """The same in seconds."""

    @property
    def median_delay(self) -> tuple[float, float]:
        """Steps and seconds, among trials with an alarm; NaN where there is none."""
        if not np.isfinite(self.delays).any():
            return math.nan, math.nan
        return float(np.nanmedian(self.delays)), float(np.nanmedian(self.delays_s))


@dataclass(frozen=True)
class DetectionReport:
    """Everything about one detector."""

    rankings: dict[str, Ranking]
    """Rankings by label: `DEVIATED`, `WILL_FAIL`; without one that has no frames of both kinds."""
    conformal: Alarms
    """At thresholds that promise a false-alarm rate, each half of the scenarios at that of the other."""
    own: Alarms | None
    """By its own decisions, where it has any."""
    calibrated: Calibration
    """Of scores as probabilities of needing help: as they are where they are probabilities, else by Platt's
    curve through the other half."""
    threshold: float
    """Conformal, from all clean rollouts: for use on other scenarios."""


def frames_of(trials: Sequence[ScoredTrial], label: str) -> MonitorFrames | None:
    """Frames that have the label; None where there are not both kinds.

    Args:
        trials: of one detector.
        label: `DEVIATED` or `WILL_FAIL`.
    """
    columns: dict[str, list[np.ndarray]] = {
        n: [] for n in ("scenario", "episode", "step", "label", "score", "decision", "recovery_step")
    }
    for number, trial in enumerate(trials):
        labels = _labels(trial, label)
        step = np.flatnonzero(labels >= 0)
        columns["scenario"].append(np.full(len(step), trial.unit, dtype=object))
        columns["episode"].append(np.full(len(step), number))
        columns["step"].append(step)
        columns["label"].append(labels[step])
        columns["score"].append(trial.scores[step])
        columns["decision"].append(trial.decisions[step])
        columns["recovery_step"].append(np.full(len(step), trial.handoff))
    if not trials:
        return None
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    if len(set(joined["label"].tolist())) < 2:
        return None
    joined["scenario"] = joined["scenario"].astype(str)
    return MonitorFrames(**joined)


def _labels(trial: ScoredTrial, label: str) -> np.ndarray:
    """(T,) 0 or 1; -1 where the frame has none."""
    found = np.full(len(trial.scores), -1, np.int64)
    if trial.start == "recovery":
        if label == DEVIATED:
            found[: trial.handoff] = 0
            found[trial.handoff :] = 1
        else:
            found[trial.handoff :] = int(not trial.success)
    elif trial.success and label == WILL_FAIL:
        found[trial.handoff :] = 0
    return found


def rank(trials: Sequence[ScoredTrial], label: str, level: float = LEVEL) -> Ranking | None:
    """Curves of a label's frames, with intervals of their areas over units; None where it has not said
    anything of both kinds."""
    frames = frames_of(trials, label)
    if frames is None or len(set(frames.label[frames.parsed].tolist())) < 2:
        return None
    row = np.unique(frames.scenario, return_inverse=True)[1]
    return Ranking(
        len(frames.label), float(frames.label.mean()), roc(frames, row, level),
        precision_recall(frames, row, level),
    )  # fmt: skip


def alarms(
    trials: Sequence[ScoredTrial], fired: Sequence[np.ndarray], level: float = LEVEL, *,
    threshold: tuple[float, ...] = (),
) -> Alarms:  # fmt: skip
    """What alarms mean.

    Args:
        trials: of one detector.
        fired: (T - handoff,) bool for each: whether it alarms at that step.
        level: confidence level.
        threshold: that they come from.
    """
    clean = [(t, f) for t, f in zip(trials, fired, strict=True) if t.clean]
    deviated = [(t, f) for t, f in zip(trials, fired, strict=True) if t.start == "recovery"]

    def share(chosen: list[tuple[ScoredTrial, np.ndarray]], weights: np.ndarray | None = None) -> Estimate:
        if not chosen:
            return UNDEFINED
        hit = np.array([[float(f.any())] for _, f in chosen])
        return resample([t.unit for t, _ in chosen], level=level).rates(hit, weights=weights)[0]

    delays = np.array([float(np.flatnonzero(f)[0]) if f.any() else np.nan for _, f in deviated])
    hz = np.array([t.control_hz for t, _ in deviated])
    return Alarms(
        threshold=threshold,
        clean=len({t.unit for t, _ in clean}),
        clean_alarmed=share(clean, _weights([t for t, _ in clean])),
        alarms_per_minute=_per_minute(clean, level),
        detected=share(deviated),
        helped=share([(t, f) for t, f in deviated if not t.success]),
        needless=share([(t, f) for t, f in deviated if t.success]),
        delays=delays,
        delays_s=delays / hz if len(hz) else delays,
    )


def _per_minute(clean: list[tuple[ScoredTrial, np.ndarray]], level: float) -> Estimate:
    """Alarms that begin, over minutes, with the cluster bootstrap's percentiles: no bound from above is known
    for a rate per time. Every first state weighs the same."""
    if not clean:
        return UNDEFINED
    begun = [float(np.sum(f & ~np.concatenate([[False], f[:-1]]))) for _, f in clean]
    minutes = [len(f) / t.control_hz / _MINUTE_S for t, f in clean]
    columns = np.stack([begun, minutes], axis=1) * _weights([t for t, _ in clean])
    sampling = resample([t.unit for t, _ in clean], level=level)
    means = sampling.means(columns)
    low, high = sampling.interval(means[:, :1] / means[:, 1:])
    return Estimate(float(columns[:, 0].sum() / columns[:, 1].sum()), float(low[0]), float(high[0]))


def _weights(trials: Sequence[ScoredTrial]) -> np.ndarray:
    """(T, 1) weights that sum to one in every unit."""
    _, index, count = np.unique([t.unit for t in trials], return_inverse=True, return_counts=True)
    return (1.0 / count[index])[:, None]


def one_of_each_unit(trials: Sequence[ScoredTrial]) -> np.ndarray:
    """(T,) bool: the first clean rollout of every unit.

    A conformal threshold takes rollouts that are exchangeable; those of one first state are alike, or the
    same one.
    """
    clean = np.flatnonzero([t.clean for t in trials])
    found = np.zeros(len(trials), bool)
    found[clean[np.unique([trials[i].unit for i in clean], return_index=True)[1]]] = True
    return found


def detection_report(
    trials: Sequence[ScoredTrial], *, alpha: float, probabilities: bool, decides: bool, seed: int = 0,
    level: float = LEVEL,
) -> DetectionReport:  # fmt: skip
    """All numbers of one detector.

    Args:
        trials: the same for every detector that is compared.
        alpha: false-alarm rate of the conformal threshold, a clean rollout.
        probabilities: its scores are probabilities of needing help, to be taken as they are.
        decides: it has decisions of its own.
        seed: of the halves.
        level: confidence level.
    """
    half = halves(np.array([t.unit for t in trials]), seed)
    highest = np.array([t.highest for t in trials])
    clean = one_of_each_unit(trials)
    limits = tuple(conformal_threshold(highest[clean & (half != h)], alpha) for h in (0, 1))
    fired = [t.after > limits[h] for t, h in zip(trials, half, strict=True)]
    labels = (DEVIATED, WILL_FAIL)
    return DetectionReport(
        rankings={label: found for label in labels if (found := rank(trials, label, level)) is not None},
        conformal=alarms(trials, fired, level, threshold=limits),
        own=alarms(trials, [t.decisions[t.handoff :] for t in trials], level) if decides else None,
        calibrated=_calibrated(trials, half, probabilities, level),
        threshold=conformal_threshold(highest[clean], alpha),
    )


def _calibrated(
    trials: Sequence[ScoredTrial], half: np.ndarray, probabilities: bool, level: float
) -> Calibration:
    by_half = [frames_of([t for t, h in zip(trials, half, strict=True) if h == k], WILL_FAIL) for k in (0, 1)]
    curves = [None if f is None else platt(f.score, f.label) for f in by_half]
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for k, frames in enumerate(by_half):
        if frames is None:
            continue
        chance = frames.score if probabilities else as_probability(frames.score, curves[1 - k])
        parts.append((chance, frames.label, frames.scenario))
    if not parts:
        empty = np.zeros(0)
        return calibration(empty, empty, empty)
    return calibration(*(np.concatenate(c) for c in zip(*parts, strict=True)), level)
