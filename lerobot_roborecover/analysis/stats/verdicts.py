"""What may be said of two policies: the one rule behind every "better", "separated", filled dot and rank."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_roborecover.analysis.stats.contrasts import Contrast
    from lerobot_roborecover.analysis.stats.runs import MethodContrast

LEAST_DIFFERING = 6
"""Units on which two policies must differ before anything is said of them: with five, all of one sign, the
exact test gives 2 / 2^5 = 0.06."""
LEAST_RUNS = 4
"""Runs of each of two methods before anything is said of the methods themselves: with three each, all of one
above all of the other, an exact test of runs gives 2 / C(6, 3) = 0.1."""


class ComparisonVerdict(StrEnum):
    """What the evidence says of policies A and B."""

    A_BETTER = "A is better"
    B_BETTER = "B is better"
    NOT_SEPARATED = "not separated"
    TOO_FEW = "too few differ"
    """They differ on fewer than `LEAST_DIFFERING` units."""
    INCOMPLETE = "incomplete"
    """One of them was not run on all scenarios of the comparison."""
    COUNTS_DEPEND = "no verdict: trial counts depend on outcomes"
    """One of them has more trials where its first ones failed, or fewer."""
    NO_VALID_TRIAL = "no verdict: no valid trial"
    """No trial of one of them ended in success or at the horizon."""
    TOO_FEW_RUNS = "too few runs"
    """Of methods: one of them has fewer than `LEAST_RUNS` runs."""

    @property
    def separated(self) -> bool:
        """Whether one of the two is better."""
        return self in (ComparisonVerdict.A_BETTER, ComparisonVerdict.B_BETTER)


def verdict(contrast: Contrast) -> ComparisonVerdict:
    """The rule: sound, complete, at least six units differ, and Holm's p in the family is below 1 - level."""
    if contrast.barred is not None:
        return contrast.barred
    if not contrast.complete:
        return ComparisonVerdict.INCOMPLETE
    if contrast.differing < LEAST_DIFFERING:
        return ComparisonVerdict.TOO_FEW
    if math.isnan(contrast.p_holm) or contrast.p_holm >= 1 - contrast.level:
        return ComparisonVerdict.NOT_SEPARATED
    return ComparisonVerdict.A_BETTER if contrast.difference.value > 0 else ComparisonVerdict.B_BETTER


def method_verdict(contrast: MethodContrast) -> ComparisonVerdict:
    """The rule for the methods behind several runs: the runs at hand are separated, each method has at least
    four, and Holm's p for other runs like these is below 1 - level, too."""
    runs = verdict(contrast.these_runs)
    if contrast.these_runs.barred is not None:
        return contrast.these_runs.barred
    if runs is ComparisonVerdict.INCOMPLETE or contrast.these_runs.sequential:
        return ComparisonVerdict.INCOMPLETE
    if min(contrast.runs) < LEAST_RUNS:
        return ComparisonVerdict.TOO_FEW_RUNS
    if not runs.separated:
        return runs
    if math.isnan(contrast.p_holm) or contrast.p_holm >= 1 - contrast.these_runs.level:
        return ComparisonVerdict.NOT_SEPARATED
    same = (contrast.difference.value > 0) == (runs is ComparisonVerdict.A_BETTER)
    return runs if same else ComparisonVerdict.NOT_SEPARATED


def method_text(contrast: MethodContrast) -> str:
    """What may be said of the methods, in a sentence."""
    found, d, c = method_verdict(contrast), contrast.difference, contrast.these_runs
    bounds = (
        "" if math.isnan(d.low) else f" ({100 * d.low:+.1f} to {100 * d.high:+.1f} for other runs like these)"
    )
    if found.separated:
        return f"Of the methods: {c.a if d.value > 0 else c.b} is better{bounds}."
    if found is ComparisonVerdict.TOO_FEW_RUNS:
        have = " and ".join(f"{name} has {n}" for name, n in zip((c.a, c.b), contrast.runs, strict=True))
        return (
            f"Of the methods nothing is said, only of these runs: {have}, and it takes {LEAST_RUNS} runs of "
            f"each before a test could tell methods from runs{bounds}."
        )
    return f"Of the methods: not separated{bounds}."


def verdict_text(contrast: Contrast) -> str:
    """The verdict in a sentence or two."""
    found, d = verdict(contrast), contrast.difference.value
    ahead = contrast.a if d > 0 else contrast.b
    points = f"{abs(100 * d):.1f} points"
    units = contrast.unit
    if found.separated:
        return f"{ahead} is better, by {points}."
    if found is ComparisonVerdict.INCOMPLETE:
        return (
            "No verdict: one of the two was not run on all the scenarios of the comparison, or not on all "
            "that its run asked for, and what it lacks may be no accident. "
            f"On the {contrast.scenarios} that both were run on, "
            + (f"{ahead} is ahead by {points}. " if d else "neither is ahead. ")
            + "Evaluate the rest, or ask for the common scenarios with --shared-scenarios-only."
        )
    if found is ComparisonVerdict.COUNTS_DEPEND:
        return (
            "No verdict: one of the two has more trials of scenarios whose first trials failed, or fewer, so "
            "its rates depend on when its runs stopped. Evaluate every scenario the same number of times "
            "(--eval.n_episodes), whatever came out."
        )
    if found is ComparisonVerdict.NO_VALID_TRIAL:
        return (
            "No verdict: one of the two has no valid trial, which says nothing of the policy. See how its "
            "trials ended (outcome and reason in its log), and evaluate again."
        )
    if found is ComparisonVerdict.TOO_FEW:
        return (
            f"No verdict: the two differ on {contrast.differing} of {contrast.units} {units}, and below "
            f"{LEAST_DIFFERING} no test can tell chance from skill. Evaluate on more scenarios."
        )
    alone = contrast.p < 1 - contrast.level
    if alone:
        return (
            f"Not separated once p is adjusted for the {contrast.family} pairs of this family, though it "
            f"would be were this pair the only one ({ahead} ahead by {points})."
        )
    if not d:
        return "Not separated with these trials: neither is ahead."
    return (
        f"Not separated with these trials: {ahead} is ahead by {points}. How many scenarios it takes to show "
        "a difference that matters, roborecover plan says."
    )
