"""Rates and intervals from trial rows, as the paper defines them ("Metrics", appendix "Estimators").

A row is a mapping with at least `scenario_id`, `trial`, `success`, `outcome`, `stage`, `deviation`, `source`
and `cluster`. A scenario's rate is the share of its scheduled trials that succeeded; invalid trials count as
failures.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.units import (
    ResamplingUnit,
    default_unit,
    initial_unit,
    unit_labels,
)
from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.scenario import Outcome, Start

DRAWS = 10_000
UNDERPOWERED_BELOW = 10
"""Scenarios of a cell below which its numbers are marked."""


class RowsError(RoboRecoverError, ValueError):
    """Trial rows do not belong together; the message says which and why."""


@dataclass(frozen=True)
class ScenarioRates:
    """One number per scenario, n scenarios in the order of their ids."""

    ids: tuple[str, ...]
    rates: np.ndarray
    """(n,) float64 in [0, 1]: successes over scheduled trials."""
    trials: np.ndarray
    """(n,) int: trials that the rates are over."""
    invalid: np.ndarray
    """(n,) int: how many of them were invalid."""
    cells: tuple[str, ...]
    """Stage × deviation type, e.g. `Approach-Wrong Pose`."""
    sources: tuple[str, ...]
    units: tuple[str, ...]
    """What is independent of the others: see `units.py`."""
    first_states: tuple[str, ...]
    """Label of the first state that each branches off from."""

    def __len__(self) -> int:
        return len(self.ids)

    def where(self, keep: Iterable[bool]) -> ScenarioRates:
        """The scenarios for which `keep` holds, in the same order."""
        index = np.flatnonzero(np.fromiter(keep, bool))
        take = lambda values: tuple(values[i] for i in index)  # noqa: E731
        return ScenarioRates(
            take(self.ids),
            self.rates[index],
            self.trials[index],
            self.invalid[index],
            take(self.cells),
            take(self.sources),
            take(self.units),
            take(self.first_states),
        )


def scenario_rates(
    rows: Sequence[Mapping[str, Any]], scheduled: int | None = None, unit: ResamplingUnit | None = None
) -> ScenarioRates:
    """Success rate of every scenario that has a row.

    Args:
        rows: trials of one policy, one start and one protocol.
        scheduled: trials every scenario was to have; those without a row count as failures. None takes the
            rows for all there is.
        unit: what is independent; by default what the paper resamples on the rows' platform, and first
            states where the rows are initial-state trials.

    Raises:
        RowsError: a trial occurs twice, a scenario's labels disagree, or more trials than scheduled.
    """
    by_scenario: dict[str, list[Mapping[str, Any]]] = {}
    seen: Counter[tuple[str, int]] = Counter()
    for row in rows:
        by_scenario.setdefault(row["scenario_id"], []).append(row)
        seen[row["scenario_id"], row["trial"]] += 1
    for (scenario, trial), count in seen.items():
        if count > 1:
            raise RowsError(
                f"trial {trial} of {scenario} occurs {count} times. Rows of several policies, starts or "
                "settings must be distinguished first (fields `policy`, `start`, `config_hash`)"
            )
    ids = tuple(sorted(by_scenario))
    groups = [by_scenario[i] for i in ids]
    counts = np.array([len(g) for g in groups], dtype=int)
    if scheduled is not None and len(ids) and counts.max() > scheduled:
        worst = ids[int(counts.argmax())]
        raise RowsError(f"{worst} has {counts.max()} trials; {scheduled} were scheduled")
    trials = counts if scheduled is None else np.full(len(ids), scheduled)
    successes = np.array([sum(bool(r["success"]) for r in g) for g in groups], dtype=float)
    return ScenarioRates(
        ids=ids,
        rates=successes / np.maximum(trials, 1),
        trials=trials,
        invalid=np.array([sum(not Outcome(r["outcome"]).valid for r in g) for g in groups], dtype=int),
        cells=tuple(_label(g, lambda r: f"{r['stage']}-{r['deviation']}") for g in groups),
        sources=tuple(_label(g, lambda r: r["source"]) for g in groups),
        units=_units(ids, groups, unit),
        first_states=_first_states(ids, groups),
    )


def initial_rate_units(found: ScenarioRates) -> tuple[np.ndarray, list[str]]:
    """Returns the rates of first states, over all trials of their scenarios, and their units.

    Scenarios that share a first state have the same initial-state trial; it counts once.

    Args:
        found: initial-state trials.
    """
    labels, column = np.unique(found.first_states, return_inverse=True)
    successes = np.bincount(column, found.rates * found.trials, len(labels))
    trials = np.bincount(column, found.trials, len(labels))
    units = dict(zip(found.first_states, found.units, strict=True))
    return successes / np.maximum(trials, 1), [units[label] for label in labels.tolist()]


def _units(
    ids: Sequence[str], groups: list[list[Mapping[str, Any]]], unit: ResamplingUnit | None
) -> tuple[str, ...]:
    platforms = sorted({str(r.get("platform", "")) for g in groups for r in g})
    if len(platforms) > 1:
        raise RowsError(
            f"the rows are of {len(platforms)} platforms ({', '.join(platforms)}); take one at a time"
        )
    initial = any(r.get("start") == Start.INITIAL for g in groups for r in g)
    labels = unit_labels(
        initial_unit(unit) if initial else unit or default_unit(platforms[0] if platforms else ""),
        ids,
        [_label(g, lambda r: r.get("cluster") or "") for g in groups],
        [_label(g, lambda r: f"{r.get('suite', '')}/{r.get('task', '')}") for g in groups],
        [_first_state(g) for g in groups],
    )
    return tuple(labels.tolist())


def _first_states(ids: Sequence[str], groups: list[list[Mapping[str, Any]]]) -> tuple[str, ...]:
    clusters = [_label(g, lambda r: r.get("cluster") or "") for g in groups]
    states = [_first_state(g) for g in groups]
    return tuple(unit_labels(ResamplingUnit.FIRST_STATE, ids, clusters, [], states).tolist())


def _first_state(group: list[Mapping[str, Any]]) -> str:
    """Of a scenario's rows; those of a log before schema 3 say none."""
    return max((row.get("first_state") or "" for row in group), default="")


def _label(group: list[Mapping[str, Any]], read: Callable[[Mapping[str, Any]], str]) -> str:
    labels = {read(row) for row in group}
    if len(labels) > 1:
        raise RowsError(
            f"scenario {group[0]['scenario_id']} has rows that disagree about it: {sorted(labels)}"
        )
    return labels.pop()


def rsr(rates: np.ndarray) -> float:
    """Recovery success rate: the mean over scenarios, each counting the same.

    Args:
        rates: (n,) in [0, 1]; NaN when n is 0.
    """
    return float(np.mean(rates)) if len(rates) else float("nan")


def macro(rates: np.ndarray, cells: Sequence[str]) -> float:
    """Macro RSR: the mean over occupied cells of the cell's mean rate (Macro-9 where nine are occupied).

    Args:
        rates: (n,) in [0, 1]; NaN when n is 0.
        cells: n labels.
    """
    if not len(rates):
        return float("nan")
    weights = np.ones((1, len(rates)))
    return float(_macro_of_draws(np.asarray(rates, float), cells, weights)[0])


def invalid_counts(rows: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Number of rows by invalid outcome; outcomes that do not occur are left out."""
    outcomes = Counter(row["outcome"] for row in rows)
    return {name: count for name, count in sorted(outcomes.items()) if not Outcome(name).valid}


def draw_counts(rng: np.random.Generator, units: int, draws: int) -> np.ndarray:
    """(draws, units) int: how often each unit is in each draw of as many with replacement."""
    drawn = rng.integers(units, size=(draws, units)) + units * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=draws * units).reshape(draws, units)


def _macro_of_draws(rates: np.ndarray, cells: Sequence[str], weights: np.ndarray) -> np.ndarray:
    """(draws,) macro rates of (draws, n) resampling weights."""
    index = np.unique(cells, return_inverse=True)[1]
    member = np.eye(index.max() + 1)[index]  # (n, cells)
    mass = weights @ member
    total = (weights * rates) @ member
    means = np.divide(total, mass, out=np.zeros_like(total), where=mass > 0)
    return means.sum(1) / (mass > 0).sum(1)
