"""Rates within groups of scenarios, and whose deviations who recovers from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.crossfit import gain_over
from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling


@dataclass(frozen=True)
class Group:
    """Every policy on one group of scenarios."""

    label: str
    scenarios: int
    estimates: tuple[Estimate, ...]
    """One a policy."""

    @property
    def underpowered(self) -> bool:
        """Too few scenarios for rate or interval to say much."""
        return self.scenarios < UNDERPOWERED_BELOW


def group_rates(
    panel: Panel, label: str, resampling: Resampling, keep: np.ndarray | None = None
) -> list[Group]:
    """Rates by group, with intervals over the group's own scenarios.

    Args:
        panel: the trials.
        label: field of the scenarios: `cell`, `source`, `suite`, `source_policy`, `task`.
        resampling: of the panel's scenarios.
        keep: (N,) bool: scenarios to look at; by default all.
    """
    labels = panel.labels(label)
    keep = np.ones(len(labels), bool) if keep is None else keep
    groups = []
    for name in panel.occupied(label):
        index = np.flatnonzero((labels == name) & keep)
        if not len(index):
            continue
        own = resampling.part(index)
        groups.append(Group(name, len(index), tuple(own.rates(panel.rates[:, index].T))))
    return groups


@dataclass(frozen=True)
class SourceRow:
    """One row of the source × recovery matrix: natural scenarios that one policy's rollouts led to."""

    source_policy: str
    scenarios: int
    rates: tuple[Estimate, ...]
    """One a recovery policy."""
    own: int | None
    """Index of the recovery policy that is the source itself; None where it was not evaluated."""
    best_other: int | None
    """Index of the observed-best alternative; None where there is no alternative."""
    gain: Estimate | None
    """Best alternative minus the source policy itself, the best chosen on half of the trials (of the
    scenarios, where trials are single) and scored on the other half; None where one of the two is missing."""
    hindsight_gain: float
    """The observed best chosen and scored on the same trials, and so too high; NaN where one is missing."""

    @property
    def underpowered(self) -> bool:
        """Too few scenarios."""
        return self.scenarios < UNDERPOWERED_BELOW


def source_matrix(panel: Panel, resampling: Resampling) -> list[SourceRow]:
    """Natural scenarios by the policy whose rollout produced the deviation × the policy that recovers."""
    natural = panel.labels("source") == "natural"
    drivers = panel.labels("source_policy")
    rows = []
    for group in group_rates(panel, "source_policy", resampling, natural & (drivers != "")):
        index = np.flatnonzero(natural & (drivers == group.label))
        own = own_arm(group.label, panel.arms)
        values = np.array([e.value for e in group.estimates])
        others = [p for p in range(len(values)) if p != own and np.isfinite(values[p])]
        best = max(others, key=lambda p: values[p]) if others else None
        gain, hindsight = None, float("nan")
        if own is not None and best is not None:
            part = resampling.part(index)
            gain = gain_over(panel.successes[:, index], panel.trials[:, index], own, others, part)
            hindsight = float(values[best] - values[own])
        rows.append(SourceRow(group.label, group.scenarios, group.estimates, own, best, gain, hindsight))
    return rows


def own_arm(source_policy: str, arms: Sequence[str]) -> int | None:
    """The arm that is the source policy itself: the same name, with or without folder and content hash."""
    wanted = _plain(source_policy)
    found = [i for i, arm in enumerate(arms) if _plain(arm) == wanted]
    return found[0] if len(found) == 1 else None


def _plain(policy: str) -> str:
    return policy.split("@")[0].split(" [")[0].rstrip("/").rsplit("/", 1)[-1].casefold()
