"""Whether probabilities mean what they say: reliability, expected calibration error, Brier score; and Platt's
map from any score to a probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    UNDEFINED,
    Estimate,
    estimate_of,
    jackknife,
    rate_interval,
)

BINS = 10
"""Equally wide, from 0 to 1 (Guo et al. 2017 take 15 of thousands of pictures)."""


@dataclass(frozen=True)
class Calibration:
    """Of N probabilities and labels."""

    brier: Estimate
    """Mean squared difference of probability and label; from 0 to 1, lower is better."""
    ece: Estimate
    """Mean difference of probability and share of label 1 within bins, weighted by their frames."""
    confidence: np.ndarray
    """(BINS,) mean probability of each bin; NaN for an empty one."""
    share: np.ndarray
    """(BINS,) share of label 1 in it."""
    frames: np.ndarray
    """(BINS,) its frames."""


def calibration(
    probability: np.ndarray, label: np.ndarray, unit: np.ndarray, level: float = LEVEL
) -> Calibration:
    """Measures probabilities, with intervals over units.

    Args:
        probability: (N,) in [0, 1]; NaN says nothing and is left out.
        label: (N,) 0 or 1.
        unit: (N,) labels of what is independent.
        level: confidence level.
    """
    known = ~np.isnan(probability)
    p, y = probability[known], label[known].astype(float)
    if not len(p):
        empty = np.full(BINS, np.nan)
        return Calibration(UNDEFINED, UNDEFINED, empty, empty, np.zeros(BINS))
    units, row = np.unique(unit[known], return_inverse=True)
    where = np.minimum((p * BINS).astype(int), BINS - 1)
    cell = row * BINS + where
    shape = (len(units), BINS)
    frames, sums, hits = (
        np.bincount(cell, w, minlength=len(units) * BINS).reshape(shape) for w in (np.ones(len(p)), p, y)
    )
    squares = np.bincount(row, (p - y) ** 2, minlength=len(units))
    weights = frames.sum(1)
    brier = _estimate(
        squares.sum() / weights.sum(),
        _left(squares.sum() - squares, weights.sum() - weights),
        weights,
        level,
    )
    gap = np.abs((sums - hits).sum(0)).sum() / weights.sum()
    without = np.abs((sums - hits).sum(0) - (sums - hits)).sum(1)
    ece = _estimate(gap, _left(without, weights.sum() - weights), weights, level)
    total = frames.sum(0)
    mean, share = (
        np.divide(v.sum(0), total, out=np.full(BINS, np.nan), where=total > 0) for v in (sums, hits)
    )
    return Calibration(brier, ece, mean, share, total)


def platt(score: np.ndarray, label: np.ndarray) -> tuple[float, float] | None:
    """Slope and offset of the logistic curve through scores and labels (Platt 1999), with his targets, which
    keep it finite where a threshold separates the labels; None without both labels.

    Args:
        score: (N,) on any scale; NaN is left out.
        label: (N,) 0 or 1.
    """
    known = np.isfinite(score)
    x, y = score[known], label[known].astype(float)
    ones, zeros = float(y.sum()), float((1 - y).sum())
    if not ones or not zeros:
        return None
    centre, scale = float(x.mean()), float(x.std()) or 1.0
    x = (x - centre) / scale
    target = np.where(y > 0.5, (ones + 1) / (ones + 2), 1 / (zeros + 2))

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        z = parameters[0] * x + parameters[1]
        slope = special.expit(z) - target
        value = float(np.mean(np.logaddexp(0, z) - target * z))
        return value, np.array([np.mean(slope * x), np.mean(slope)])

    found = optimize.minimize(loss, np.zeros(2), jac=True, method="L-BFGS-B").x
    return float(found[0] / scale), float(found[1] - found[0] * centre / scale)


def as_probability(score: np.ndarray, curve: tuple[float, float] | None) -> np.ndarray:
    """(N,) probabilities of scores by a curve of `platt`; NaN without one."""
    return np.full(len(score), np.nan) if curve is None else special.expit(curve[0] * score + curve[1])


def _left(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    return np.divide(top, bottom, out=np.zeros(len(top)), where=bottom > 0)


def _estimate(value: float, left_out: np.ndarray, weights: np.ndarray, level: float) -> Estimate:
    return estimate_of(value, rate_interval(jackknife(value, left_out, weights), level))
