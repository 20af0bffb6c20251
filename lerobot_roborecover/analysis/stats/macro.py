"""Macro RSR: the mean over cells (stage × deviation type) of the cell's mean rate.

Two numbers stand side by side. Macro-k averages the k cells of the scenario set that are large enough to say
something (`LEAST_IN_CELL`); cells below that are named and left out. Macro-9 averages the paper's nine cells
and nothing else, so that it compares with the paper: it has no value where one of the nine is empty, and no
interval where one is too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import (
    LEVEL,
    UNDEFINED,
    Estimate,
    clean,
    estimate_of,
    rate_interval,
    spread,
)
from lerobot_roborecover.analysis.stats.panel import CELLS, Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling, masked_mean

LEAST_IN_CELL = 7
"""Independent units that a cell must have to count in Macro. In `benchmarks/coverage.py --small-cells`, where
the smallest of nine cells is unlike the others, the interval covers at least 92 % in every setting from seven
units on; with three it covers 81 %. A cell of one or two makes it 83 or 23 points wide instead of 10."""
PAPER_CELLS = (
    "Approach-Wrong Target",
    "Approach-Wrong Pose",
    "Approach-Stage Rollback",
    "Approach-Scene Change",
    "Contact-Wrong Pose",
    "Move-Wrong Pose",
    "Place-Wrong Target",
    "Place-Wrong Pose",
    "Place-Scene Change",
)
"""The nine cells that the paper's test sets occupy (its table of stages and types)."""
MACRO_9 = "Macro-9"
"""Name of the mean over `PAPER_CELLS`, and of no other."""


@dataclass(frozen=True)
class MacroCells:
    """Which cells of a scenario set count in Macro, and which are too small."""

    sizes: dict[str, int]
    """Independent units of every occupied cell, in the paper's order of stages and types."""

    @property
    def counted(self) -> tuple[str, ...]:
        return tuple(cell for cell, size in self.sizes.items() if size >= LEAST_IN_CELL)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Occupied cells below `LEAST_IN_CELL`."""
        return tuple(cell for cell in self.sizes if cell not in self.counted)

    @property
    def is_macro_9(self) -> bool:
        """Whether Macro averages exactly the paper's nine cells."""
        return set(self.counted) == set(PAPER_CELLS)

    @property
    def title(self) -> str:
        """`Macro-9` where the counted cells are the paper's nine, else `Macro-k` of k cells."""
        count = len(self.counted)
        if self.is_macro_9:
            return MACRO_9
        return f"Macro-{count}" if count != len(PAPER_CELLS) else f"Macro over {count} cells of this set"

    def notes(self, unit: str) -> list[str]:
        """Which cells Macro leaves out, and what Macro-9 lacks.

        Args:
            unit: what is independent, in the plural.
        """
        found = []
        if self.left_out:
            names = ", ".join(f"{_name(cell)} ({self.sizes[cell]})" for cell in self.left_out)
            where = self.title if self.counted else "Macro"
            found.append(f"Left out of {where}, with fewer than {LEAST_IN_CELL} {unit}: {names}.")
        empty = [_name(cell) for cell in PAPER_CELLS if cell not in self.sizes]
        small = [_name(cell) for cell in PAPER_CELLS if cell in self.left_out]
        if empty:
            found.append(
                f"{MACRO_9} is not defined: no scenario in {len(empty)} of the paper's nine cells "
                f"({', '.join(empty)})."
            )
        elif small:
            found.append(
                f"{MACRO_9} has no interval: {', '.join(small)} below the least size of a cell "
                f"({LEAST_IN_CELL} {unit})."
            )
        return found


def _name(cell: str) -> str:
    return cell.replace("-", " ", 1)


def macro_cells(cells: Sequence[str] | np.ndarray, units: Sequence[str] | np.ndarray) -> MacroCells:
    """Sizes of the cells of N scenarios.

    Args:
        cells: N labels.
        units: N labels of what is independent.
    """
    members: dict[str, set] = {}
    for cell, unit in zip(cells, units, strict=True):
        members.setdefault(str(cell), set()).add(unit)
    order = [*(c for c in CELLS if c in members), *sorted(set(members) - set(CELLS))]
    return MacroCells({cell: len(members[cell]) for cell in order})


def cells_of(panel: Panel, resampling: Resampling) -> MacroCells:
    """Sizes of the cells of a panel's scenarios."""
    return macro_cells(panel.labels("cell"), resampling.index)


def macro_estimates(panel: Panel, resampling: Resampling) -> list[Estimate]:
    """Macro RSR of every policy, over the panel's cells that count.

    Undefined for a policy that was run on fewer than `LEAST_IN_CELL` units of one of them: a mean over fewer
    cells is another number.
    """
    counted = cells_of(panel, resampling).counted
    return [
        estimate if set(counted) <= set(sizes.counted) else UNDEFINED
        for estimate, sizes in zip(
            _over_cells(panel, resampling, counted), _by_policy(panel, resampling), strict=True
        )
    ]


def macro_9_estimates(panel: Panel, resampling: Resampling) -> list[Estimate]:
    """Macro-9 of every policy, over the paper's nine cells.

    Undefined for a policy without a trial in one of the nine; without an interval for a policy that was run
    on fewer than `LEAST_IN_CELL` units of one.
    """
    return [
        _macro_9(estimate, sizes)
        for estimate, sizes in zip(
            _over_cells(panel, resampling, PAPER_CELLS), _by_policy(panel, resampling), strict=True
        )
    ]


def _macro_9(estimate: Estimate, sizes: MacroCells) -> Estimate:
    if not set(PAPER_CELLS) <= set(sizes.sizes):
        return UNDEFINED
    if not set(PAPER_CELLS) <= set(sizes.counted):
        return Estimate(estimate.value, float("nan"), float("nan"))
    return estimate


def _over_cells(panel: Panel, resampling: Resampling, cells: Sequence[str]) -> list[Estimate]:
    labels = panel.labels("cell")
    values = np.where(np.isin(labels, cells), panel.rates, np.nan)
    return resampling.rates(values.T, cells=labels)


def _by_policy(panel: Panel, resampling: Resampling) -> list[MacroCells]:
    """Sizes of the cells on the scenarios that each policy was run on."""
    labels, known = panel.labels("cell"), np.isfinite(panel.rates)
    return [macro_cells(labels[run], resampling.index[run]) for run in known]


def macro_of_scenarios(
    rates: np.ndarray, units: Sequence[str], cells: Sequence[str], level: float = LEVEL
) -> tuple[Estimate, Estimate]:
    """Macro over the cells that count, and Macro-9, of one policy's scenarios.

    Args:
        rates: (n,) in [0, 1].
        units: n labels of what is independent.
        cells: n labels.
        level: confidence level.
    """
    sizes, labels = macro_cells(cells, units), np.asarray(cells, dtype=str)

    def over(chosen: Sequence[str]) -> Estimate:
        if not set(chosen) & set(sizes.sizes):
            return UNDEFINED
        found = spread(np.where(np.isin(labels, chosen), rates, np.nan), units, cells=labels)
        return estimate_of(found.value, rate_interval(found, level))

    return over(sizes.counted), _macro_9(over(PAPER_CELLS), sizes)


def percentile_macro(
    panel: Panel, resampling: Resampling, cells: Sequence[str] | None = None
) -> list[Estimate]:
    """The paper's percentile bootstrap of Macro RSR, to compare with the paper.

    A draw that leaves a cell empty averages the others.

    Args:
        panel: the trials.
        resampling: of its scenarios.
        cells: to average, by default all that are occupied; a policy that lacks one has no value.
    """
    labels = panel.labels("cell")
    chosen = panel.occupied("cell") if cells is None else tuple(cells)
    member = np.stack([labels == cell for cell in chosen])  # (C, N)
    policies = len(panel.arms)
    values = np.where(member[None], panel.rates[:, None, :], np.nan).reshape(policies * len(chosen), -1).T
    points = masked_mean(values).reshape(policies, len(chosen))
    draws = resampling.means(values).reshape(-1, policies, len(chosen))
    low, high = resampling.interval(_mean_of_known(draws))
    return [
        UNDEFINED
        if cells is not None and np.isnan(own).any()
        else Estimate(float(v), float(clean(a)), float(clean(b)))
        for v, a, b, own in zip(_mean_of_known(points), low, high, points, strict=True)
    ]


def _mean_of_known(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values)
    total, count = np.where(known, values, 0).sum(-1), known.sum(-1)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
