"""Tables of robots' trials: how far starts were off beside each rate, and whether that moved verdicts."""

from __future__ import annotations

import math
from dataclasses import replace

from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.second_rater import FOLDER, agreement_of
from lerobot_roborecover.analysis.stats.start_error import MEASURES, summary, verdict_slope
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.logs.log_file import TRIALS_FILE
from lerobot_roborecover.scenario import Outcome

_MIN_SECONDS = 60.0
_OVERALL = ("Trials", "Successes %")


def robot_tables(results: Results) -> list[Table]:
    """Starts, verdicts against start errors, and second raters where there are any; none of simulated
    trials."""
    if not of_robots(results):
        return []
    raters = second_raters(results)
    return [starts(results), slopes(results), *([raters] if raters.rows else [])]


def of_robots(results: Results) -> bool:
    """Whether any trial was on a robot."""
    return any(row.robot is not None for arm in results.study.arms for row in arm.rows)


def outcome_words(outcome: Outcome, robots: bool) -> str:
    """What tables and figures call an outcome.

    Args:
        outcome: of a trial.
        robots: the trials are of robots, where a person judges and equipment fails.
    """
    on_robots = {
        Outcome.HORIZON: "failure",
        Outcome.SIM_ERROR: "equipment, or called invalid",
        Outcome.STATE_MISMATCH: "not run",
    }
    return (on_robots if robots else {}).get(outcome, outcome.value.replace("_", " "))


def starts_in_short(results: Results) -> Table:
    """The medians of the start errors, for a terminal."""
    table = starts(results)
    kept = [
        i for i, c in enumerate(table.columns) if not c.title.endswith("90 %") and c.title not in _OVERALL
    ]
    return replace(
        table,
        title="",
        columns=tuple(table.columns[i] for i in kept),
        rows=tuple(tuple(row[i] for i in kept) for row in table.rows),
        notes=(),
    )


def second_raters(results: Results) -> Table:
    """How verdicts of second raters go with the first ones."""
    logs = [log for log in results.study.logs if log.name == TRIALS_FILE]
    folders = sorted({log.parent for log in logs if (log.parent / FOLDER).is_dir()})
    rows = [
        (rater, count, share, kappa)
        for folder in folders
        for rater, (count, share, kappa) in agreement_of(folder).items()
    ]
    columns = (
        Column("Second rater"), Column("Trials", "count"), Column("Alike %", "percent"),
        Column("Cohen's kappa", "ratio"),
    )  # fmt: skip
    notes = (
        "Verdicts from the recordings, given blind, against those given at the robot. Kappa: agreement "
        "beyond chance; not defined where a rater gave one verdict alone. No rate of this report uses them.",
    )
    return Table("robot_raters", "Agreement of raters", columns, tuple(rows), notes)


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
        Column("Not run", "count"),
        *(Column(f"{words}: {kind}", "ratio") for _, words in MEASURES for kind in ("median", "90 %")),
        Column("Minutes a reset", "number"),
    )  # fmt: skip
    notes = (
        "Start error: how far robot and scene were from the recovery point when the policy took over; the "
        "worst joint, camera and object region of each trial, as measured. Not run: the start was outside "
        "the tolerance, or a person skipped it. Policies whose starts differ are not compared fairly.",
    )
    return Table("robot_starts", "Where robots' trials started", columns, tuple(rows), notes)


def slopes(results: Results) -> Table:
    """Verdict against start error."""
    rows = [row for arm in results.study.arms for row in arm.rows]
    slopes = {words: verdict_slope(rows, name, results.draws.level) for name, words in MEASURES}
    found = tuple((words, s.trials, s.estimate, s.reason) for words, s in slopes.items())
    notes = (
        "Logistic regression of the verdict on the start error, with an intercept for each policy: change of "
        "the log-odds of success per unit. A policy whose verdicts are all alike says nothing of it. An "
        "interval that holds 0 does not show that the starts mattered; a wide one does not show that they "
        "did not.",
    )
    columns = (
        Column("Start error"), Column("Trials", "count"), Column("Log-odds per unit", "ratio"),
        Column("No number because"),
    )  # fmt: skip
    return Table("robot_slopes", "Verdict against start error", columns, found, notes)
