"""LIBERO's goal predicates, and an order in which a task's can be reached one after the other."""

from __future__ import annotations

from collections.abc import Sequence

GOAL_KINDS = ("on", "in", "open", "close", "turnon")
"""Every predicate of the four suites' goals."""
PLACE_KINDS = ("on", "in")
"""Those about where an object is."""
PREDICATES = {"turnon": 0, "open": 0, "on": 1, "in": 1, "close": 2, "turnoff": 2}
"""Predicates of a goal that the controllers know, and when their turn comes."""


def turn_of(predicate: Sequence[str]) -> int:
    """When a predicate's turn comes, the lowest first."""
    return PREDICATES.get(predicate[0], 1)


def workable_order(predicates: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """LIBERO's order, but what is opened or turned on comes first, and what is closed comes last.

    Args:
        predicates: each with its arguments, e.g. `("in", "mug_1", "microwave_1_heating_region")`.
    """
    return [tuple(p) for p in sorted(predicates, key=turn_of)]
