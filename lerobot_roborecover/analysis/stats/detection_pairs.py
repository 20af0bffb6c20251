"""Which of two detectors ranks frames better: paired differences of AUROC on the same trials, adjusted.

Units are left out one at a time, for both detectors alike: the jackknife of the difference, whose variance
goes into the interval of every other difference of rates, and p is that interval's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from lerobot_roborecover.analysis.stats.contrasts import Contrast, adjusted
from lerobot_roborecover.analysis.stats.detection import WILL_FAIL, DetectionReport
from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    difference_interval,
    difference_p,
    estimate_of,
    jackknife,
)
from lerobot_roborecover.analysis.stats.monitor_curves import Curve
from lerobot_roborecover.analysis.stats.permutation import differing


def detector_contrasts(
    reports: Mapping[str, DetectionReport],
    *,
    against: Sequence[str] = (),
    level: float = LEVEL,
) -> list[Contrast]:
    """Differences of AUROC for `WILL_FAIL`, one family; detectors that have none are left out.

    Args:
        reports: by name, of the same trials in the same order.
        against: names; only pairs with one of them are asked about. Empty: all pairs.
        level: confidence level.
    """
    curves = {n: r.rankings[WILL_FAIL].roc for n, r in reports.items() if WILL_FAIL in r.rankings}
    pairs = [
        (a, b) if b in against or not against else (b, a)
        for a, b in combinations(curves, 2)
        if not against or a in against or b in against
    ]
    return adjusted([_contrast(a, curves[a], b, curves[b], level) for a, b in pairs])


def _contrast(a: str, x: Curve, b: str, y: Curve, level: float) -> Contrast:
    value = x.area.value - y.area.value
    weights = np.maximum(x.weights, y.weights)
    left_out = x.left_out - y.left_out
    found = jackknife(value, left_out, weights)
    count = int(found.units)
    return Contrast(
        a,
        b,
        estimate_of(value, difference_interval(found, level)),
        difference_p(found),
        float("nan"),
        count,
        count,
        differing(left_out[weights > 0] - value),
        0,
        True,
        level,
        "scenarios",
    )
