"""How far annotators agree before anything is resolved: raw, Fleiss' kappa and Krippendorff's alpha.

Pure functions of counts. Intervals are over episodes, from `analysis.stats.intervals`. The paper reports
agreement rates of 92.17 % (stage) and 82.82 % (type) before majority resolution (appendix, "Annotation and
Recovery-Point Selection") and does not say whether a rate is over pairs of annotators or over episodes on
which all agree; both are given here.

Kappa and alpha are 1 - D_o / D_e, disagreement over that by chance, both means over episodes. Their interval
is the hull of two: Fieller's, of the ratio of the two, which knows that few episodes pin D_e down badly; and
that of the rate D_o at the D_e observed, which knows that no disagreement so far is not none for ever. Chosen
by simulation (`benchmarks/coverage.py`); each alone covers too seldom with few episodes or a rare label.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import (
    Estimate,
    clean,
    rate_interval,
    ratio_interval,
    spread,
)
from lerobot_roborecover.curation.annotation.votes import Vote
from lerobot_roborecover.utils.text import align

NAN = Estimate(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class Agreement:
    """Agreement on one axis; NaN where it is not defined."""

    axis: str
    episodes: int
    """Episodes with at least two values on this axis; the others say nothing about agreement."""
    pairs: Estimate
    """Raw: share of pairs of annotators that agree, averaged over episodes."""
    unanimous: Estimate
    """Raw: share of episodes on which all that gave a value agree."""
    kappa: Estimate
    """Fleiss' kappa, over the episodes that every annotator gave a value."""
    alpha: Estimate
    """Krippendorff's alpha: nominal for labels, interval for steps."""


def agreement(votes: Mapping[str, Sequence[Vote]], raters: int, tolerance_steps: int) -> list[Agreement]:
    """Agreement on every axis.

    Args:
        votes: by candidate, at most one vote an annotator; blind ones of the first round.
        raters: number of annotators.
        tolerance_steps: two recovery points at most this far apart agree.

    Returns:
        Axes keep (recovery or discard), stage, type, cell (stage and type at once), step.
    """
    ordered = [votes[c] for c in sorted(votes)]
    recovery = [[v for v in given if v.verdict == "recovery"] for given in ordered]
    labels: dict[str, list[list[str]]] = {
        "keep": [[v.verdict for v in given] for given in ordered],
        "stage": [[v.stage for v in given] for given in recovery],
        "type": [[v.deviation for v in given] for given in recovery],
        "cell": [[f"{v.stage}-{v.deviation}" for v in given] for given in recovery],
    }
    steps = [[float(v.step) for v in given if v.step is not None] for given in recovery]
    found = [nominal_agreement(axis, values, raters) for axis, values in labels.items()]
    return [*found, step_agreement(steps, tolerance_steps)]


def nominal_agreement(axis: str, values: Sequence[Sequence[str]], raters: int) -> Agreement:
    """Agreement on labels.

    Args:
        axis: its name.
        values: labels given to each episode.
        raters: number of annotators.
    """
    counts = label_counts([given for given in values if len(given) > 1])
    rated = counts.sum(1)
    if not len(counts):
        return Agreement(axis, 0, NAN, NAN, NAN, NAN)
    pairwise = (counts * (counts - 1)).sum(1) / (rated * (rated - 1))
    unanimous = (counts.max(1) == rated).astype(float)
    complete = counts[rated == raters]
    return Agreement(
        axis,
        len(counts),
        _rate(pairwise),
        _rate(unanimous),
        coefficient(kappa_terms(complete), kappa_parts) if len(complete) else NAN,
        coefficient(nominal_terms(counts), nominal_parts),
    )


def step_agreement(values: Sequence[Sequence[float]], tolerance: float) -> Agreement:
    """Agreement on recovery points; kappa is not defined for numbers.

    Args:
        values: steps given to each episode.
        tolerance: two steps at most this far apart agree.
    """
    rated = [given for given in values if len(given) > 1]
    if not rated:
        return Agreement("step", 0, NAN, NAN, NAN, NAN)
    pairwise = [np.mean([abs(a - b) <= tolerance for a, b in combinations(given, 2)]) for given in rated]
    unanimous = [float(max(given) - min(given) <= tolerance) for given in rated]
    return Agreement(
        "step",
        len(rated),
        _rate(np.array(pairwise)),
        _rate(np.array(unanimous)),
        NAN,
        coefficient(interval_terms(_filled(rated)), interval_parts, None),
    )


def label_counts(values: Sequence[Sequence[str]]) -> np.ndarray:
    """(N, C) float64: how often each episode was given each of the labels that occur."""
    labels = sorted({label for given in values for label in given})
    return np.array([[given.count(label) for label in labels] for given in values], dtype=float).reshape(
        len(values), len(labels)
    )


def kappa_terms(counts: np.ndarray) -> np.ndarray:
    """(..., 2 + C) what Fleiss' kappa is made of, by episode: 1, pairwise agreement, label shares."""
    rated = counts.sum(-1, keepdims=True)
    pairwise = (counts * (counts - 1)).sum(-1, keepdims=True) / (rated * (rated - 1))
    return np.concatenate([np.ones_like(rated), pairwise, counts / rated], axis=-1)


def _filled(values: Sequence[Sequence[float]]) -> np.ndarray:
    """(N, most) with NaN after the values of an episode that has fewer."""
    found = np.full((len(values), max(map(len, values))), np.nan)
    for row, given in zip(found, values, strict=True):
        row[: len(given)] = given
    return found


Parts = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(...) disagreement and (...) disagreement by chance, from (..., terms) sums over episodes."""


def kappa_parts(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of Fleiss' kappa, which equals `statsmodels.stats.inter_rater.fleiss_kappa`."""
    episodes = sums[..., :1]
    return 1 - sums[..., 1] / episodes[..., 0], 1 - ((sums[..., 2:] / episodes) ** 2).sum(-1)


def nominal_terms(counts: np.ndarray) -> np.ndarray:
    """(..., 1 + C) sums that alpha is made of, by episode: disagreeing pairs over m - 1, and label counts.

    Hayes and Krippendorff (2007), "Answering the Call for a Standard Reliability Measure for Coding Data".
    """
    rated = counts.sum(-1, keepdims=True)
    observed = (counts * (rated - counts)).sum(-1, keepdims=True) / (rated - 1)
    return np.concatenate([observed, counts], axis=-1)


def nominal_parts(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    total = sums[..., 1:].sum(-1)
    expected = (sums[..., 1:] * (total[..., None] - sums[..., 1:])).sum(-1)
    return sums[..., 0] / total, expected / (total * (total - 1))


def interval_terms(values: np.ndarray) -> np.ndarray:
    """(..., 4) sums that alpha is made of, by episode: squared differences over m - 1, m, sum, and sum of
    squares.

    Args:
        values: (..., m) steps; NaN where an annotator gave none.
    """
    m = np.isfinite(values).sum(-1)
    first, second = np.nansum(values, -1), np.nansum(values**2, -1)
    return np.stack([2 * (m * second - first**2) / (m - 1), m, first, second], axis=-1)


def interval_parts(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of alpha with squared differences."""
    observed, total, first, second = np.moveaxis(sums, -1, 0)
    return observed / total, 2 * (total * second - first**2) / (total * (total - 1))


def _rate(values: np.ndarray) -> Estimate:
    found = spread(values)
    return Estimate(float(found.value), *(float(v) for v in rate_interval(found)))


def coefficient(terms: np.ndarray, parts: Parts, largest: float | None = 1.0) -> Estimate:
    """1 - D_o / D_e with its interval, of one sample of episodes; arguments as of `coefficients`."""
    return Estimate(*(float(v) for v in coefficients(terms, parts, largest)))


def coefficients(
    terms: np.ndarray, parts: Parts, largest: float | None = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1 - D_o / D_e and its bounds, of one or many samples of episodes.

    Args:
        terms: (..., N, terms) by episode.
        parts: of the coefficient.
        largest: disagreement that an episode can have; None where there is no bound, and twice the one by
            chance is taken.

    Returns:
        Values, lower and upper bounds, (...) each. NaN where chance alone would not disagree; bounds also
        where the episodes are too few to say that it would.
    """
    episodes, total = terms.shape[-2], terms.sum(-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        observed, expected = parts(total)
        left_out = parts(total[..., None, :] - terms)
        expected = np.where(expected > 1e-9, expected, np.nan)
        value = 1 - observed / expected
        scale = 2 * expected if largest is None else np.full(np.shape(expected), largest)
        # What each episode contributes to the two means: jackknife pseudo-values.
        by_episode, by_chance = (
            (episodes * whole[..., None] - (episodes - 1) * part) / scale[..., None]
            for whole, part in zip((observed, expected), left_out, strict=True)
        )
        low, high = ratio_interval(by_episode, by_chance)
        least, most = rate_interval(spread(by_episode))
        # Where one has no bounds, the two have none.
        low = np.minimum(low, least * scale / expected)
        high = np.maximum(high, most * scale / expected)
    return value, clean(1 - high), clean(1 - low)


def format_agreement(rows: Sequence[Agreement]) -> str:
    """The table as text: per cent, with 95 % intervals."""

    def cell(estimate: Estimate, scale: float, digits: int) -> str:
        if estimate.value != estimate.value:
            return "n/a"
        value = f"{scale * estimate.value:.{digits}f}"
        if estimate.low != estimate.low:
            return value
        return f"{value} [{scale * estimate.low:.{digits}f}, {scale * estimate.high:.{digits}f}]"

    head = ("axis", "episodes", "pairs %", "all agree %", "Fleiss kappa", "Kripp. alpha")
    cells = [
        (
            row.axis, row.episodes, cell(row.pairs, 100, 1), cell(row.unanimous, 100, 1),
            cell(row.kappa, 1, 3), cell(row.alpha, 1, 3),
        )
        for row in rows
    ]  # fmt: skip
    return "\n".join(align([head, *cells], left=(0, 2, 3, 4, 5)))
