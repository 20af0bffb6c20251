"""A plan as tables and a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.analysis.figures.style import (
    DASHES,
    LINE,
    SOFT,
    Figure,
    Plot,
    Width,
    both,
    colour,
    drawing,
)
from lerobot_roborecover.analysis.stats.power import Plan, PowerAssumptions, detectable
from lerobot_roborecover.analysis.tables import Column, Table


def plan_table(
    plans: Sequence[Plan], guess: PowerAssumptions, wanted: float, level: float, family: int
) -> Table:
    """What every difference takes, by trials a scenario."""
    rows = [
        (
            f"{100 * p.difference:g}", p.trials,
            "more than a million" if p.scenarios is None else str(p.scenarios),
            "" if p.scenarios is None else str(p.scenarios * p.trials), p.power, p.simulated,
        )
        for p in plans
    ]  # fmt: skip
    columns = (
        Column("Difference, points"), Column("Trials per scenario", "count"), Column("Scenarios"),
        Column("Trials of one policy"), Column("Power %", "percent"),
        Column("by simulation, %", "percent"),
    )  # fmt: skip
    return Table(
        "plan",
        f"Scenarios that separate two policies with {100 * wanted:g} % chance",
        columns,
        tuple(rows),
        (_believed(guess), _tested(level, family)),
    )


def detectable_table(
    guess: PowerAssumptions, scenarios: int, trials: Sequence[int], wanted: float, level: float, family: int
) -> Table:
    """The least difference that a set can show, by trials a scenario."""
    rows = [(k, scenarios * k, detectable(guess, scenarios, k, wanted, level, family)) for k in trials]
    columns = (
        Column("Trials per scenario", "count"), Column("Trials of one policy", "count"),
        Column("Least difference", "points"),
    )  # fmt: skip
    return Table(
        "detectable",
        f"Least difference that {scenarios} scenarios separate with {100 * wanted:g} % chance, in points",
        columns,
        tuple(rows),
        (_believed(guess), _tested(level, family)),
    )


def _believed(guess: PowerAssumptions) -> str:
    return (
        f"Believed: the worse policy solves {100 * guess.rate:.1f} %; the true rates of scenarios scatter by "
        f"{100 * guess.sd:.1f} points (SD) around it; those of the two policies correlate "
        f"by {guess.correlation:.2f}. Scenarios are the units: where several come of one trajectory, read "
        "clusters."
    )


def _tested(level: float, family: int) -> str:
    pairs = "the only pair" if family == 1 else f"the first of {family} pairs (Holm)"
    return (
        f"Test: the report's, paired sign flips over scenarios, at {1 - level:.3g} for {pairs}. By "
        "simulation: the exact test on 300 made-up studies of that size, give or take 5."
    )


def detectable_figure(
    guess: PowerAssumptions,
    trials: Sequence[int],
    wanted: float,
    level: float,
    family: int,
    *,
    at: int | None = None,
    differences: Sequence[float] = (),
) -> Figure:
    """The least difference against the number of scenarios, a line for each number of trials.

    Args:
        guess: of the policies.
        trials: of a scenario.
        wanted: power.
        level: confidence level.
        family: pairs that p is adjusted for.
        at: scenarios of the set at hand.
        differences: that are planned for.
    """
    counts = np.unique(np.geomspace(10, 1000, 60).round().astype(int))
    lines = {k: [100 * detectable(guess, int(n), k, wanted, level, family) for n in counts] for k in trials}

    def draw(width: Width) -> Plot:
        with drawing() as subplots:
            plot, axes = subplots(width.inches, 4.2 if not width.narrow else 3.6)
            for i, (k, values) in enumerate(lines.items()):
                label = f"{k} trial" + "s" * (k > 1)
                axes.plot(counts, values, DASHES[i % len(DASHES)], color=colour(i), lw=2, label=label)
            for d in differences:
                axes.axhline(100 * d, color=LINE, lw=1)
            if at is not None:
                axes.axvline(at, color=SOFT, lw=1)
                axes.annotate(f"{at}", (at, 1), (3, -10), xycoords=("data", "axes fraction"),
                              textcoords="offset points", color=SOFT, fontsize=9)  # fmt: skip
            axes.set_xscale("log")
            ticks = [10, 20, 50, 100, 200, 500, 1000]
            axes.set_xticks(ticks, [str(t) for t in ticks])
            axes.minorticks_off()
            axes.set(xlim=(10, 1000), ylim=(0, None), xlabel="scenarios")
            axes.set_ylabel(f"least difference, points, at {100 * wanted:g} % power")
            axes.legend(title="per scenario")
            axes.grid(color=LINE, lw=0.4)
            axes.set_axisbelow(True)
        return plot

    shown = {k: dict(zip(counts.tolist(), values, strict=True)) for k, values in lines.items()}
    words = "; ".join(
        f"{k} trials a scenario: "
        + ", ".join(f"{n} scenarios {v:.0f}" for n, v in list(of.items())[::15] if not math.isnan(v))
        for k, of in shown.items()
    )
    return Figure("plan", "Least difference that a set separates", f"In points. {words}.", *both(draw))
