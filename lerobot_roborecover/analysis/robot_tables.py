"""Tables of robots' trials: how far starts were off beside each rate, and whether that moved verdicts."""

from __future__ import annotations

import math

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.start_error import MEASURES, summary, verdict_slope
from lerobot_roborecover.analysis.tables import Column, Table

_MIN_SECONDS = 60.0


def robot_tables(results: Results) -> list[Table]:
    """Both tables; none of simulated trials."""
    rows = [row for arm in results.study.arms for row in arm.rows]
    if not any(row.robot is not None for row in rows):
        return []
    return [starts(results), slopes(results)]


def starts(results: Results) -> Table:
    """Start errors beside every rate."""
    rows = []
    panel = results.recovery
    for index, title in enumerate(panel.arms):
        own = [r for (arm, _), found in panel.rows.items() if arm == index for r in found]
        found = summary(own)
        tried = int(panel.trials[index].sum())
        rate = float(panel.successes[index].sum()) / tried if tried else math.nan
        spread = [v for pair in zip(found.medians, found.ninety, strict=True) for v in pair]
        rows.append((title, found.trials, rate, found.not_run, *spread, found.reset_s / _MIN_SECONDS))
    columns = (
        Column("Policy"), Column("Trials", "count"), Column("Successes %", "percent"),
        Column("Not run: start too far off", "count"),
        *(Column(f"{words}: {kind}", "ratio") for _, words in MEASURES for kind in ("median", "90 %")),
        Column("Minutes a reset", "number"),
    )  # fmt: skip
    notes = (
        "Start error: how far robot and scene were from the recovery point when the policy took over; the "
        "worst joint, camera and object region of each trial, as measured. Policies whose starts differ are "
        "not compared fairly.",
    )
    return Table("robot_starts", "Where robots' trials started", columns, tuple(rows), notes)


def slopes(results: Results) -> Table:
    """Verdict against start error."""
    rows = [row for arm in results.study.arms for row in arm.rows]
    found = tuple((words, verdict_slope(rows, name, results.draws.level)) for name, words in MEASURES)
    notes = (
        "Logistic regression of the verdict on the start error, with an intercept for each policy: change of "
        "the log-odds of success per unit. An interval that holds 0 does not show that the starts mattered; "
        "a wide one does not show that they did not.",
    )
    columns = (Column("Start error"), Column("Log-odds per unit", "ratio"))
    return Table("robot_slopes", "Verdict against start error", columns, found, notes)
