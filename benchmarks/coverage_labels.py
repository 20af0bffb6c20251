"""Made-up monitors and annotators, and how often the intervals of `detect evaluate-frames` and
`curate agree` hold: two parts of `coverage.py`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from coverage_settings import SIZES, Line, held, rng_of
from scipy import special

from lerobot_roborecover.analysis.stats.intervals import rate_interval, spread
from lerobot_roborecover.analysis.stats.monitor import METRICS, MonitorFrames
from lerobot_roborecover.analysis.stats.monitor_report import monitor_report
from lerobot_roborecover.curation import agreement

MONITORS = {
    "fair, scenarios alike": (0.7, 0.3),
    "fair, scenarios scatter": (1.0, 1.5),
    "good": (2.0, 1.0),
    "very good": (3.0, 0.7),
}
"""Distance of the two labels' logits from zero, and how far scenarios' logits scatter."""
STEPS = 16
"""Frames of a scenario."""
LARGE = 20_000
"""Scenarios that the truth is worked out from."""


def monitors(replicates: int) -> Iterator[Line]:
    """Frame metrics, areas under curves, and delays, over scenarios."""
    for name, (apart, scatter) in MONITORS.items():
        truth = _monitor_numbers(_frames(rng_of("monitor", name), LARGE, apart, scatter), large=True)
        for n in SIZES:
            rng = rng_of("monitor", name, n)
            count = max(50, replicates // (8 if n < 200 else 16))
            found = [_monitor_numbers(_frames(rng, n, apart, scatter)) for _ in range(count)]
            for what, true in truth.items():
                bounds = np.array([(each[what].low, each[what].high) for each in found]).T
                yield held(f"monitor: {what}", n, name, bounds, true)


def _frames(rng, n: int, apart: float, scatter: float) -> MonitorFrames:
    step = np.tile(np.arange(STEPS), n)
    start = np.repeat(rng.integers(3, STEPS - 3, n), STEPS)
    label = (step >= start).astype(np.int64)
    own = np.repeat(scatter * rng.standard_normal(n), STEPS)
    score = special.expit(apart * (2 * label - 1) + own + rng.standard_normal(n * STEPS))
    scenario = np.repeat(np.arange(n), STEPS)
    return MonitorFrames(scenario, scenario, step, label, score, score > 0.5, start)


def _monitor_numbers(frames: MonitorFrames, large: bool = False) -> dict:
    """Estimates by name; of the large sample, numbers."""
    if not large:
        report = monitor_report(frames)
        named = {name: report.metrics[name] for name in METRICS}
        named["average precision"] = report.precision_recall.area
        named["AUROC"] = report.roc.area
        named["mean delay"] = report.episodes.delay_mean
        return named
    one, flagged = frames.label == 1, frames.decision
    recall, fpr, precision = flagged[one].mean(), flagged[~one].mean(), one[flagged].mean()
    order = np.argsort(-frames.score)
    hits = np.cumsum(one[order])
    ranks = np.empty(len(order))
    ranks[order[::-1]] = np.arange(1, len(order) + 1)
    zeros, ones = (~one).sum(), one.sum()
    f1 = 2 * precision * recall / (precision + recall)
    tn, fn, fp = (~flagged & ~one).sum(), (~flagged & one).sum(), (flagged & ~one).sum()
    since = np.where(one & flagged, frames.step - frames.recovery_step, STEPS).reshape(-1, STEPS).min(1)
    return {
        "accuracy": (flagged == one).mean(),
        "precision": precision,
        "recall": recall,
        "f1": f1,
        "macro_f1": (f1 + 2 * tn / (2 * tn + fn + fp)) / 2,
        "false_positive_rate": fpr,
        "average precision": (hits / np.arange(1, len(order) + 1))[one[order]].mean(),
        "AUROC": (ranks[one].sum() - ones * (ones + 1) / 2) / (ones * zeros),
        "mean delay": since[since < STEPS].mean(),
    }


LABELS = {
    "2 labels": np.array([0.5, 0.5]),
    "2 labels, one rare": np.array([0.85, 0.15]),
    "4 labels": np.array([0.4, 0.3, 0.2, 0.1]),
    "9 labels": np.arange(9, 0, -1) / 45,
}
SKILL = {"0.5": (0.5, None), "0.8": (0.8, None), "0.95": (0.95, None), "0.8, episodes scatter": (0.8, 5.0)}
"""Chance that an annotator sees the true label, else draws one at random; concentration of its beta
distribution between episodes."""


def annotators(replicates: int) -> Iterator[Line]:
    """Agreement of two and three annotators, over episodes."""
    for n in SIZES:
        for raters in (2, 3):
            for labels, shares in LABELS.items():
                for skill, (mean, scatter) in SKILL.items():
                    rng = rng_of("labels", n, raters, labels, skill)
                    setting = f"{raters} annotators, {labels}, skill {skill}"
                    squared = mean**2 if scatter is None else mean**2 + mean * (1 - mean) / (scatter + 1)
                    counts = _votes(rng, replicates, n, raters, shares, mean, scatter)
                    kappa = agreement.kappa_terms(counts)
                    pairs = rate_interval(spread(kappa[..., 1]))
                    alike = squared + (1 - squared) * (shares**2).sum()
                    yield held("agreement: pairs", n, setting, pairs, alike)
                    bounds = agreement.coefficients(kappa, agreement.kappa_parts)[1:]
                    yield held("agreement: Fleiss' kappa", n, setting, bounds, squared)
                    terms = agreement.nominal_terms(counts)
                    bounds = agreement.coefficients(terms, agreement.nominal_parts)[1:]
                    yield held("agreement: Krippendorff's alpha", n, setting, bounds, squared)
            for setting, (share, slips) in MARKS.items():
                rng = rng_of("steps", n, raters, setting)
                terms = _marks(rng, replicates, n, raters, share, slips)
                bounds = agreement.coefficients(terms, agreement.interval_parts, None)[1:]
                what = "agreement: alpha of recovery points"
                yield held(what, n, f"{raters} annotators, {setting}", bounds, share)


def _votes(rng, replicates: int, n: int, raters: int, shares: np.ndarray, mean: float, scatter) -> np.ndarray:
    """(replicates, n, labels) counts."""
    shape = (replicates, n)
    skill = mean if scatter is None else rng.beta(mean * scatter, (1 - mean) * scatter, (*shape, 1))
    drawn = rng.choice(len(shares), (*shape, raters + 1), p=shares)
    given = np.where(rng.random((*shape, raters)) < skill, drawn[..., :1], drawn[..., 1:])
    return (given[..., None] == np.arange(len(shares))).sum(-2).astype(float)


MARKS = {"near": (0.9, False), "far": (0.5, False), "near but for slips": (0.8, True)}
"""Share of the recovery points' variance that is the episodes'; whether the rest is of few marks, far off."""


def _marks(rng, replicates: int, n: int, raters: int, share: float, slips: bool) -> np.ndarray:
    """(replicates, n, 4) terms of alpha for recovery points."""
    noise = rng.standard_normal((replicates, n, raters))
    if slips:
        noise *= np.where(rng.random(noise.shape) < 0.1, np.sqrt(10), 0.0)
    points = np.sqrt(share) * rng.standard_normal((replicates, n, 1)) + np.sqrt(1 - share) * noise
    return agreement.interval_terms(points)
