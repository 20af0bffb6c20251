"""A threshold with a promise: split conformal prediction at a chosen false-alarm rate.

Of n clean rollouts that nothing else was chosen on, each has its highest score. The k-th smallest of these,
k = ceil((n + 1) (1 - alpha)), is passed by the highest score of one more such rollout with probability at
most alpha, whatever the detector and however the scores are distributed (Vovk et al. 2005; Lei et al. 2018),
as long as the rollouts are exchangeable: one of each first state, since a deterministic policy does the same
from the same first state. With fewer than 1 / alpha - 1 rollouts nothing can be promised, and the threshold
is infinite.
"""

from __future__ import annotations

import math

import numpy as np


def conformal_threshold(highest: np.ndarray, alpha: float) -> float:
    """The score above which to alarm.

    Args:
        highest: (n,) highest score of each clean rollout; NaN (nothing was said) counts as never alarming.
        alpha: chance of an alarm in one more clean rollout, at most; above 0 and below 1.

    Raises:
        ValueError: alpha is no such rate.
    """
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"a false-alarm rate of {alpha} is not above 0 and below 1")
    values = np.sort(np.where(np.isnan(highest), -np.inf, highest))
    # Rounded first: (9 + 1) * (1 - 0.1) must not become 10 for a bit.
    k = math.ceil(round((len(values) + 1) * (1 - alpha), 9))
    return float(values[k - 1]) if k <= len(values) else math.inf


def least_rollouts(alpha: float) -> int:
    """Clean rollouts below which a threshold at this rate is infinite."""
    return math.ceil(round(1 / alpha, 9)) - 1


def halves(units: np.ndarray, seed: int) -> np.ndarray:
    """(N,) 0 or 1: every unit in one of two halves, drawn by lot.

    Args:
        units: (N,) labels of what must stay together.
        seed: of the lot.
    """
    names, index = np.unique(units, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return (np.argsort(order) % 2)[index]
