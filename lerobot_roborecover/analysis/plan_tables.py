"""A plan as tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lerobot_roborecover.analysis.stats.power import Plan, PowerAssumptions, detectable
from lerobot_roborecover.analysis.tables import Column, Table


def plan_table(
    plans: Sequence[Plan],
    guess: PowerAssumptions,
    wanted: float,
    level: float,
    family: int,
    robot_minutes: float | None = None,
) -> Table:
    """What every difference takes, by trials a scenario.

    Args:
        plans: of each difference.
        guess: what is believed.
        wanted: chance.
        level: confidence.
        family: pairs.
        robot_minutes: that a trial on a robot takes, its reset included; None leaves the hours out.
    """
    rows = [
        (
            f"{100 * p.difference:g}", p.trials,
            "more than a million" if p.scenarios is None else str(p.scenarios),
            "" if p.scenarios is None else str(p.scenarios * p.trials), p.power, p.simulated,
            *_hours(p, robot_minutes),
        )
        for p in plans
    ]  # fmt: skip
    columns = (
        Column("Difference, points"), Column("Trials per scenario", "count"), Column("Scenarios"),
        Column("Trials of one policy"), Column("Power %", "percent"),
        Column("by simulation, %", "percent"),
        *(() if robot_minutes is None else (Column("Hours at the robot, both policies", "number"),)),
    )  # fmt: skip
    return Table(
        "plan",
        f"Scenarios that separate two policies with {100 * wanted:g} % chance",
        columns,
        tuple(rows),
        (_believed(guess), _tested(level, family)),
    )


def _hours(plan: Plan, minutes: float | None) -> tuple[float, ...]:
    if minutes is None:
        return ()
    return (math.nan if plan.scenarios is None else 2 * plan.scenarios * plan.trials * minutes / 60,)


def detectable_table(
    guess: PowerAssumptions, scenarios: int, trials: Sequence[int], wanted: float, level: float, family: int
) -> Table:
    """The least difference that a set can show, by trials a scenario."""
    rows = [(k, scenarios * k, detectable(guess, scenarios, k, wanted, level, family)) for k in trials]
    columns = (
        Column("Trials per scenario", "count"), Column("Trials of one policy", "count"),
        Column("Least difference", "points"),
    )  # fmt: skip
    hopeless = [str(row[0]) for row in rows if math.isnan(row[2])]
    none = (
        f"None at {', '.join(hopeless)} trials per scenario: the other policy would have to solve more than "
        "everything. More scenarios are needed."
    )
    return Table(
        "detectable",
        f"Least difference that {scenarios} scenarios separate with {100 * wanted:g} % chance, in points",
        columns,
        tuple(rows),
        (*((none,) if hopeless else ()), _believed(guess), _tested(level, family)),
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
