"""Which policies are ranked, and on which scenarios: the largest complete table of the logs.

A policy that was run on a few scenarios only has no rate to rank beside those that were run on all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Compared:
    """Policies and scenarios of the ranking; every one of the policies was run on every one of the
    scenarios."""

    policies: tuple[int, ...]
    """Indices of arms."""
    scenarios: tuple[int, ...]
    """Indices of scenarios."""
    complete: bool
    """Whether that is every policy on every scenario."""
    words: str
    """Which they are, in a sentence; empty where nothing was left out."""


def compared(
    run: np.ndarray, names: tuple[str, ...], *, common: bool = False, lacking: Mapping[int, str] | None = None
) -> Compared:
    """Chooses the policies and scenarios that are ranked.

    Of the tables that the policies with most scenarios fill together (the first one, the first two, ...), it
    is the one with the most entries, and of equal ones that with more policies.

    Args:
        run: (P, N) bool: which policy was run on which scenario.
        names: P names.
        common: take all policies, on the scenarios common to all.
        lacking: policies that did not finish what they were to be run on, and what they lack; none of them is
            ranked beside one that did.
    """
    policies, scenarios = run.shape
    lacking = lacking or {}
    if 0 < len(lacking) < policies:
        run = run & ~np.isin(np.arange(policies), list(lacking))[:, None]
    order = np.argsort(-run.sum(1), kind="stable")
    shared = np.logical_and.accumulate(run[order], axis=0).sum(1)
    size = shared * np.arange(1, policies + 1)
    most = policies if common else int(np.flatnonzero(size == size.max())[-1]) + 1
    chosen = tuple(sorted(int(p) for p in order[:most]))
    keep = tuple(int(n) for n in np.flatnonzero(run[list(chosen)].all(0)))
    words = []
    if len(keep) < scenarios and len(chosen) == policies:
        words.append(f"policies are ranked on the {len(keep)} of {scenarios} scenarios that all were run on")
    elif len(chosen) < policies:
        left = ", ".join(
            f"{names[p]} ({lacking.get(p) or f'{int(run[p].sum())} of {scenarios}'})"
            for p in range(policies)
            if p not in chosen
        )
        on = f"all {scenarios}" if len(keep) == scenarios else f"the same {len(keep)} of {scenarios}"
        who = "policy" if len(chosen) == 1 else "policies"
        words.append(
            f"{len(chosen)} of {policies} policies are ranked, the {who} run on {on} scenarios; not run on "
            f"all of them, and so neither ranked nor judged: {left}. --shared-scenarios-only "
            "ranks all on what all were run on"
        )
    return Compared(chosen, keep, len(chosen) == policies and len(keep) == scenarios, "; ".join(words))
