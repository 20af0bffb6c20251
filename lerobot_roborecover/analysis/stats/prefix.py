"""Recovery by the length of the prefix: how far into its task a scenario's recovery point lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW
from lerobot_roborecover.analysis.stats.groups import Group
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling

MOST_GROUPS = 4
"""Quarters of the scenarios, where there are enough."""


@dataclass(frozen=True)
class PrefixGroup(Group):
    """Every policy on the scenarios whose prefixes are about as long."""

    median_steps: float
    """Of its scenarios' prefixes."""


def prefix_steps(panel: Panel) -> np.ndarray:
    """(N,) int: actions of every scenario's prefix, as its trials replayed them; 0 where no trial says it."""
    steps = np.zeros(len(panel.scenarios), int)
    for (_, n), rows in panel.rows.items():
        steps[n] = max(steps[n], *(row.handoff_step for row in rows), 0)
    return steps


def prefix_groups(panel: Panel, resampling: Resampling) -> list[PrefixGroup]:
    """Rates by length of the prefix, shortest first, in groups of about as many scenarios.

    Args:
        panel: trials from recovery points.
        resampling: of the panel's scenarios; the intervals are over its units.

    Returns:
        Up to four groups of at least ten scenarios or so (equal lengths stay together); none where the
        lengths are not known, or make one group.
    """
    steps = prefix_steps(panel)
    known = np.flatnonzero(steps)
    wanted = min(MOST_GROUPS, len(known) // UNDERPOWERED_BELOW)
    if wanted < 2:
        return []
    edges = np.quantile(steps[known], np.arange(1, wanted) / wanted)
    of = np.searchsorted(edges, steps[known])
    groups = []
    for k in np.unique(of):
        index = known[of == k]
        low, high = steps[index].min(), steps[index].max()
        label = str(low) if low == high else f"{low} to {high}"
        rates = tuple(resampling.part(index).rates(panel.rates[:, index].T))
        groups.append(PrefixGroup(label, len(index), rates, float(np.median(steps[index]))))
    return groups if len(groups) > 1 else []
