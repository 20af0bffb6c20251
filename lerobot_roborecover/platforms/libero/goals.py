"""A LIBERO task's goal predicates, in an order in which they can be reached one after the other."""

from __future__ import annotations

from collections.abc import Sequence

GOAL_KINDS = ("on", "in", "open", "close", "turnon")
"""Every predicate of the four suites' goals."""


def workable_order(predicates: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """LIBERO's order, but what is to be closed is closed last: something has to go in before.

    Args:
        predicates: each with its arguments, e.g. `("in", "mug_1", "microwave_1_heating_region")`.
    """
    return [tuple(p) for p in sorted(predicates, key=lambda p: p[0] == "close")]
