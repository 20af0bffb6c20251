"""Tables of what forks gained: all of them, by step, by cell, and by both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW
from lerobot_roborecover.analysis.stats.fork_gain import ForkGains
from lerobot_roborecover.analysis.stats.units import (
    ESTIMAND,
)
from lerobot_roborecover.analysis.tables import Column, Table

_NUMBERS = (
    Column("Forks", "count"), Column("Scenarios", "count"), Column("Continue %", "percent"),
    Column("Intervene %", "percent"), Column("Gain, points", "points"),
)  # fmt: skip


def gain_tables(gains: ForkGains) -> list[Table]:
    """All forks, by step, by cell, and by both."""
    arms, steps, cells = gains.arms, gains.steps, gains.cells
    notes = (
        "Gain: success with the intervention, less success when the same policy continues from the same "
        "step of the same trial. Every scenario counts the same; intervals (95 %) speak of "
        f"{ESTIMAND[gains.unit]}. They are not adjusted for the number of rows: a row that was picked by its "
        "gain is to be tried on other scenarios.",
        f"Forks left out because they, or their continuation, are invalid: {gains.unpaired}.",
    )
    return [
        _table(gains, "fork_gain", "Recovery gain", {"Arm": arms}, notes),
        _table(gains, "fork_gain_by_step", "By step of the trial", {"Arm": arms, "Step": steps}),
        _table(gains, "fork_gain_by_cell", "By cell", {"Arm": arms, "Cell": cells}),
        _table(
            gains, "fork_gain_by_cell_and_step", "By cell and step",
            {"Arm": arms, "Cell": cells, "Step": steps},
        ),
    ]  # fmt: skip


def _table(
    gains: ForkGains, name: str, title: str, by: Mapping[str, Sequence], notes: tuple[str, ...] = ()
) -> Table:
    rows, sparse = [], set()
    combined: list[tuple] = [()]
    for values in by.values():
        combined = [(*head, value) for head in combined for value in values]
    for head in combined:
        chosen = dict(zip(by, head, strict=True))
        forks, scenarios, *estimates = gains.of(
            chosen["Arm"], step=chosen.get("Step"), cell=chosen.get("Cell")
        )
        if not forks:
            continue
        if scenarios < UNDERPOWERED_BELOW:
            sparse.add(len(rows))
        rows.append((*head, forks, scenarios, *estimates))
    columns = [Column(title, "count" if title == "Step" else "text") for title in by]
    return Table(name, title, (*columns, *_NUMBERS), tuple(rows), notes, frozenset(sparse))
