"""The paper's percentile bootstrap, by the book."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import DRAWS, draw_counts
from lerobot_roborecover.analysis.stats.intervals import LEVEL, clean


def bootstrap_interval(
    rates: np.ndarray,
    cells: Sequence[str] | None = None,
    *,
    clusters: Sequence[str] | None = None,
    draws: int = DRAWS,
    level: float = LEVEL,
    rng: np.random.Generator | None = None,
) -> tuple[float, float]:
    """The paper's interval: percentile bootstrap of `rsr`, or of `macro` where cells are given.

    On its own, so that the package's `Resampling.percentile` and `percentile_macro` can be held against it.

    A draw takes as many scenarios (or clusters) as there are, with replacement. In a draw that leaves a cell
    empty, the macro rate is the mean over the others.

    Args:
        rates: (n,) in [0, 1].
        cells: n labels; None for the interval of `rsr`.
        clusters: n labels of the units to resample; None resamples scenarios.
        draws: bootstrap draws (paper: 10,000).
        level: confidence level.
        rng: source of the draws; by default one seeded with 0, so that a table is reproducible.

    Returns:
        Lower and upper bound; NaN for fewer than two units, which say nothing about spread.
    """
    rates = np.asarray(rates, float)
    units = np.arange(len(rates)) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    count = int(units.max()) + 1 if len(units) else 0
    if count < 2:
        return float("nan"), float("nan")
    rng = rng or np.random.default_rng(0)
    weights = draw_counts(rng, count, draws)[:, units]  # (draws, n)
    if cells is None:
        values = weights @ rates / weights.sum(1)
    else:
        member = np.unique(cells, return_inverse=True)[1][:, None] == np.arange(len(set(cells)))
        mass = weights @ member
        means = np.divide((weights * rates) @ member, mass, out=np.zeros(mass.shape), where=mass > 0)
        values = means.sum(1) / (mass > 0).sum(1)
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2])
    return float(clean(low)), float(clean(high))
