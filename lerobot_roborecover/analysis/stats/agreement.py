"""Whether a rate that was measured here agrees with one that others have published."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy import stats

from lerobot_roborecover.analysis.stats.intervals import LEVEL, Estimate, independent_difference

MARGIN = 0.10
"""A loss that a comparison has to be able to show before it counts as agreement."""


class AgreementVerdict(StrEnum):
    """What may be said of a rate beside a published one."""

    AGREES = "agrees"
    """No difference is shown, and one of the margin would have been."""
    UNDECIDED = "undecided"
    """No difference is shown, but a loss of the margin could hide in so few trials."""
    LOWER = "lower"
    HIGHER = "higher"
    UNPUBLISHED = "unpublished"
    UNMEASURED = "unmeasured"
    """No trial was valid, so that there is no rate."""


@dataclass(frozen=True)
class ScoreAgreement:
    """A measured rate beside a published one; rates in [0, 1]."""

    measured: Estimate
    published: Estimate
    """Its bounds are NaN where none were published; it is then taken as exact."""
    difference: Estimate
    """Measured less published."""
    standing: AgreementVerdict


def agreement(measured: Estimate, published: Estimate | None, margin: float = MARGIN) -> ScoreAgreement:
    """Compares two rates from different trials by the interval of their difference.

    Args:
        measured: here; undefined where no trial was valid.
        published: by others; None where there is nothing.
        margin: in (0, 1), the loss that must not be able to hide.
    """
    nothing = Estimate(math.nan, math.nan, math.nan)
    if math.isnan(measured.value):
        return ScoreAgreement(measured, published or nothing, nothing, AgreementVerdict.UNMEASURED)
    if published is None or math.isnan(measured.low):
        return ScoreAgreement(measured, published or nothing, nothing, AgreementVerdict.UNPUBLISHED)
    bounds = (_or(bound, published.value) for bound in (published.low, published.high))
    difference = independent_difference(measured, Estimate(published.value, *bounds))
    if difference.high < 0:
        standing = AgreementVerdict.LOWER
    elif difference.low > 0:
        standing = AgreementVerdict.HIGHER
    else:
        standing = AgreementVerdict.AGREES if difference.low > -margin else AgreementVerdict.UNDECIDED
    return ScoreAgreement(measured, published, difference, standing)


def mixed_rate(rates: Sequence[float], shares: Sequence[float], episodes: int | None) -> Estimate:
    """A published rate by suite, weighed as another set is made up.

    Args:
        rates: in [0, 1], one a suite.
        shares: of each suite in the other set; sum to 1.
        episodes: behind each rate; None where it is not said, and then there is no interval.

    Returns:
        With Wilson's interval of each rate, put together as above.
    """
    p, w = np.asarray(rates, float), np.asarray(shares, float)
    value = float(p @ w)
    if episodes is None:
        return Estimate(value, math.nan, math.nan)
    found = [stats.binomtest(round(rate * episodes), episodes).proportion_ci(LEVEL, "wilson") for rate in p]
    below, above = (np.array([getattr(ci, side) for ci in found]) for side in ("low", "high"))
    return Estimate(
        value,
        max(value - float(np.sqrt(((w * (p - below)) ** 2).sum())), 0.0),
        min(value + float(np.sqrt(((w * (above - p)) ** 2).sum())), 1.0),
    )


def _or(bound: float, otherwise: float) -> float:
    return otherwise if math.isnan(bound) else bound
