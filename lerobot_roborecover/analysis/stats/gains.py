"""Gains of interventions by group of scenarios, and what is left of each gain without the group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling


@dataclass(frozen=True)
class GroupGain:
    """An intervention less its direct control on one group of scenarios, and on all others."""

    group: str
    inside: Contrast
    """Holm-adjusted for the interventions on this group."""
    outside: Contrast | None
    """Holm-adjusted for the interventions on the other scenarios; None where there are no others."""


def gains_by_group(
    panel: Panel, pairs: Sequence[tuple[int, int]], groups: np.ndarray, resampling: Resampling
) -> list[GroupGain]:
    """Returns the gains of every intervention, group by group, the largest group first.

    Args:
        panel: direct controls and interventions.
        pairs: (direct control, intervention) indices of arms.
        groups: (N,) str labels of the panel's scenarios.
        resampling: of the panel's scenarios.
    """
    names, counts = np.unique(groups, return_counts=True)
    found = []
    for name in names[np.argsort(-counts, kind="stable")].tolist():
        inside = _gains(panel, pairs, np.flatnonzero(groups == name), resampling)
        others = np.flatnonzero(groups != name)
        outside = _gains(panel, pairs, others, resampling) if len(others) else [None] * len(pairs)
        found += [GroupGain(name, a, b) for a, b in zip(inside, outside, strict=True)]
    return found


def _gains(
    panel: Panel, pairs: Sequence[tuple[int, int]], scenarios: np.ndarray, resampling: Resampling
) -> list[Contrast]:
    turned = [(arm, base) for base, arm in pairs]
    return contrasts(panel.rates[:, scenarios], panel.arms, resampling.part(scenarios), turned)


def groups_by_controller(panel: Panel) -> np.ndarray:
    """(N,) str: construction source and the policy or program whose rollout led to the scenario."""
    drivers = panel.labels("source_policy")
    return np.array(
        [f"{s}, {d}" if d else s for s, d in zip(panel.labels("source"), drivers, strict=True)], dtype=str
    )
