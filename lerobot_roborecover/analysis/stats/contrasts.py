"""Paired contrasts of policies on the same scenarios, adjusted for their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.permutation import differing, sign_flip_p
from lerobot_roborecover.analysis.stats.resampling import Resampling
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict, verdict


@dataclass(frozen=True)
class Contrast:
    """Policy a minus policy b over the scenarios that both were run on."""

    a: str
    b: str
    difference: Estimate
    """Difference of the two rates, in [-1, 1]."""
    p: float
    """Two-sided p-value of the paired sign-flip permutation test; NaN without a common scenario."""
    p_holm: float
    """The same after Holm's adjustment for all contrasts of the family; NaN for one outside of it."""
    scenarios: int
    """From initial states: first states."""
    units: int
    """Units of those scenarios: scenarios, trajectory clusters, first states, or tasks."""
    differing: int
    """Units on which the two differ."""
    family: int
    """Contrasts that p is adjusted for."""
    complete: bool
    """Whether both were run on all the scenarios of the comparison; other contrasts are in no family."""
    level: float
    unit: str
    """What the units are, in words."""
    sequential: bool = False
    """Whether p and interval hold although the run was watched, and stopped when it was decided."""
    barred: ComparisonVerdict | None = None
    """Why no verdict can rest on one of the two, see `soundness.py`; such a contrast is in no family."""

    @property
    def verdict(self) -> ComparisonVerdict:
        return verdict(self)

    def reversed(self) -> Contrast:
        """The same, b minus a."""
        d = self.difference
        return replace(self, a=self.b, b=self.a, difference=Estimate(-d.value, -d.high, -d.low))


def contrasts(
    rates: np.ndarray,
    names: Sequence[str],
    resampling: Resampling,
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    unit: str = "scenarios",
    complete: bool = True,
    barred: Mapping[str, ComparisonVerdict] | None = None,
) -> list[Contrast]:
    """Paired contrasts, which are one family: what is asked of them is one question.

    Args:
        rates: (P, N) in [0, 1]; NaN where a policy was not run.
        names: P names.
        resampling: of the N scenarios.
        pairs: which, by index; by default all.
        unit: what is resampled, in words.
        complete: whether the policies are complete; p is not adjusted, and nothing said, where they are not.
        barred: names of policies that no verdict can rest on, and why.
    """
    pairs = list(combinations(range(len(rates)), 2)) if pairs is None else list(pairs)
    if not pairs:
        return []
    differences = np.stack([rates[a] - rates[b] for a, b in pairs])
    totals = [_unit_totals(values, resampling) for values in differences]
    units = np.asarray(resampling.spread(differences).units)
    estimates = resampling.differences(differences.T)
    found = [
        Contrast(
            names[a],
            names[b],
            estimates[k],
            sign_flip_p(totals[k]),
            float("nan"),
            int(np.isfinite(differences[k]).sum()),
            int(units[k]),
            differing(totals[k]),
            0,
            complete and not {names[a], names[b]} & set(barred or ()),
            resampling.level,
            unit,
            barred=None if barred is None else barred.get(names[a], barred.get(names[b])),
        )
        for k, (a, b) in enumerate(pairs)
    ]
    return adjusted(found)


def adjusted(found: Sequence[Contrast]) -> list[Contrast]:
    """The contrasts with p adjusted by Holm's rule; the complete ones among them are one family."""
    p = np.array([c.p if c.complete else np.nan for c in found])
    known = np.isfinite(p)
    p[known] = holm(p[known])
    family = int(known.sum())
    return [
        replace(c, p_holm=float(q), family=family if c.complete else 0) for c, q in zip(found, p, strict=True)
    ]


def holm(p: np.ndarray) -> np.ndarray:
    """p-values adjusted for all tests of a family (Holm 1979); the smallest is multiplied by their number,
    the next one by one less, and none falls below one before it.

    Args:
        p: (..., tests).
    """
    order = np.argsort(p, axis=-1)
    times = np.arange(p.shape[-1], 0, -1)
    adjusted = np.maximum.accumulate(np.take_along_axis(p, order, -1) * times, axis=-1)
    found = np.empty_like(p)
    np.put_along_axis(found, order, np.minimum(adjusted, 1.0), -1)
    return found


def _unit_totals(values: np.ndarray, resampling: Resampling) -> np.ndarray:
    """Sums over each unit with a value."""
    known = np.isfinite(values)
    index = resampling.index[known]
    totals = np.bincount(index, values[known], resampling.units)
    return totals[np.bincount(index, minlength=resampling.units) > 0]


@dataclass(frozen=True)
class Share:
    """What one group of scenarios contributes to a difference; the contributions add up to it."""

    group: str
    scenarios: int
    difference: float
    """Mean over the group's scenarios."""
    contribution: float
    """Times the group's share of all scenarios."""


def contributions(a: np.ndarray, b: np.ndarray, groups: np.ndarray) -> list[Share]:
    """Where the difference of two policies comes from, largest contribution first.

    Args:
        a: (N,) rates; NaN where not run.
        b: (N,) rates.
        groups: (N,) labels.

    Raises:
        RowsError: no scenario has both rates.
    """
    difference = a - b
    known = np.isfinite(difference)
    if not known.any():
        raise RowsError("the two have no scenario in common")
    shares = []
    for group in np.unique(groups[known]):
        inside = difference[known & (groups == group)]
        shares.append(Share(str(group), len(inside), float(inside.mean()), float(inside.sum() / known.sum())))
    return sorted(shares, key=lambda s: (-abs(s.contribution), s.group))
