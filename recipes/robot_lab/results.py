"""The study's tables and figure, from its outcomes alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.figures.style import LINE, colour, dash, drawing, marker, svg_of
from lerobot_roborecover.analysis.stats.start_error import verdict_slope
from lerobot_roborecover.analysis.tables import Column, Table
from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.row import TrialRow
from recipes.robot_lab.bench import MM_PER_PX, POLICIES
from recipes.robot_lab.comparisons import (
    AA_NAMES,
    AA_SIZES,
    MARGIN,
    OFFSETS_MM,
    aa_studies,
    exact_rates,
    mean_rate,
    paired,
    restored_rates,
)
from recipes.robot_lab.start_errors import METAWORLD, SETUPS, accuracy

WHERE = "Simulated lab."


def part_a(records: Sequence[dict[str, Any]]) -> list[Table]:
    """Estimated against true start error."""
    rows = []
    for name in (*SETUPS, METAWORLD):
        found = accuracy([r for r in records if r["setup"] == name])
        rows.append((
            name, found.placings, found.missing, found.bias_mm, found.spread_mm, found.within_mm,
            found.missed, found.refused, found.camera_px,
        ))  # fmt: skip
    columns = (
        Column("Camera set-up"), Column("Placings", "count"), Column("No number", "count"),
        Column("Bias, mm", "number"), Column("SD, mm", "number"), Column("90 % within, mm", "number"),
        Column("Let in %", "percent"), Column("Refused %", "percent"), Column("Camera moved, px", "number"),
    )  # fmt: skip
    notes = (
        f"{WHERE} Estimated minus true error of placing the puck, 0 to 30 mm. Let in: of placings 15 mm off "
        "and more, those measured as at most 10 mm. Refused: of placings at most 5 mm off, those measured as "
        "more than 10 mm. Pixels of the slanted camera have the scale that fits them best.",
    )
    return [Table("start_errors", "Estimated against true start error", columns, tuple(rows), notes)]


def part_b(rows: Sequence[TrialRow], true_mm: np.ndarray, exact: Sequence[dict[str, Any]]) -> list[Table]:
    """RSR with restored starts against exact replay.

    Args:
        rows: of the run.
        true_mm: (N,) of the trials with a rollout, in their order.
        exact: records of trials from exact starts.
    """
    found = []
    for name in POLICIES:
        own = exact_rates(exact, [name], 0.0)
        everything, valid = restored_rates(rows, name), restored_rates(rows, name, valid_only=True)
        found.append((
            name, len(own), mean_rate(own), mean_rate(everything), paired(everything, own).difference,
            paired(everything, own).p, paired(valid, own).difference,
        ))  # fmt: skip
    columns = (
        Column("Policy"), Column("Points", "count"), Column("RSR %, exact replay", "percent"),
        Column("RSR %, restored", "percent"), Column("Restored less exact, points", "points"),
        Column("p", "p"), Column("The same, valid trials alone", "points"),
    )  # fmt: skip
    notes = (
        f"{WHERE} From each point one trial of each policy with a restored start, two with the exact one.",
    )
    rates = Table("restored", "RSR with restored starts and with exact replay", columns, tuple(found), notes)
    return [rates, _measured(rows, true_mm)]


def _measured(rows: Sequence[TrialRow], true_mm: np.ndarray) -> Table:
    """Start errors of the run: true, estimated, and the verdict against the estimate."""
    run = sorted((r for r in rows if r.outcome != "state_mismatch"), key=_order)
    errors = [RobotTrial.of_json(r.robot or {}).start_error for r in run]
    pixels = [None if e is None else e.cameras["top"].object_px for e in errors]
    estimated = MM_PER_PX * np.array([np.nan if p is None else p for p in pixels])
    gap = estimated - true_mm
    joints = [0.0 if e is None else e.worst("joint") or 0.0 for e in errors]
    slope = verdict_slope(list(rows), "object_px").estimate
    values: tuple[tuple[str, float | int | str], ...] = (
        ("trials run", len(run)),
        ("starts refused", len(rows) - len(run)),
        ("true error of the puck, median, mm", round(float(np.median(true_mm)), 1)),
        ("true error of the puck, 90 %, mm", round(float(np.quantile(true_mm, 0.9)), 1)),
        ("estimated error of the puck, median, mm", round(float(np.nanmedian(estimated)), 1)),
        ("estimated minus true, mean, mm", round(float(np.nanmean(gap)), 1)),
        ("estimated minus true, SD, mm", round(float(np.nanstd(gap, ddof=1)), 1)),
        ("arm, worst joint, median, mm", round(float(np.median(joints)), 1)),
        ("log-odds of success per px, report's own estimate", _interval(slope)),
    )
    shown = tuple((what, str(value)) for what, value in values)
    return Table(
        "restored_starts", "Starts of the run", (Column("Measure"), Column("Value")), shown, (WHERE,)
    )


def _order(row: TrialRow) -> int:
    return RobotTrial.of_json(row.robot or {}).order


def _interval(estimate: Any) -> str:
    return f"{estimate.value:.2f} [{estimate.low:.2f}, {estimate.high:.2f}]"


def part_c(rows: Sequence[TrialRow]) -> list[Table]:
    """A/A comparisons.

    Args:
        rows: of the run in which one policy has two names.
    """
    own = paired(*(restored_rates(rows, name) for name in AA_NAMES))
    found: list[tuple[Any, ...]] = [
        (
            "the run itself", own.scenarios, len(rows) // (2 * own.scenarios), 1, int(own.verdict.separated),
            float(own.verdict.separated), int(own.p < 0.05), abs(own.difference.value),
        )
    ]  # fmt: skip
    for points, repeats in AA_SIZES:
        s = aa_studies(rows, points, repeats)
        found.append((
            "dealt anew", s.points, s.repeats, s.studies, s.separated, s.separated / s.studies, s.p_below,
            s.largest,
        ))  # fmt: skip
    columns = (
        Column("Trials"), Column("Points", "count"), Column("Repeats", "count"), Column("Studies", "count"),
        Column("False alarms", "count"), Column("%", "percent"), Column("p < 0.05", "count"),
        Column("Largest difference, points", "points"),
    )  # fmt: skip
    notes = (
        f"{WHERE} One policy under two names. Studies dealt anew take their trials, without replacement "
        "within a study, from the run's, so that they share them with one another.",
    )
    return [Table("aa", "A/A comparisons", columns, tuple(found), notes)]


def part_d(records: Sequence[dict[str, Any]]) -> list[Table]:
    """How much start error a verdict bears."""
    rows = []
    for title, names in (("both", list(POLICIES)), *((name, [name]) for name in POLICIES)):
        exact = exact_rates(records, names, 0.0)
        rows.append((title, 0.0, mean_rate(exact), None, None, _differ(records, names), None))
        for offset in OFFSETS_MM:
            own = exact_rates(records, names, offset)
            c = paired(own, exact)
            borne = c.difference.low >= -MARGIN and c.difference.high <= MARGIN
            rows.append((
                title, offset, mean_rate(own), c.difference, c.p, _flips(records, names, offset),
                "borne" if borne else "changed" if c.verdict.separated else "not shown",
            ))  # fmt: skip
    columns = (
        Column("Policy"), Column("Puck off by, mm", "number"), Column("RSR %", "percent"),
        Column("Less exact start, points", "points"), Column("p", "p"),
        Column("Verdicts that flip %", "percent"), Column("RSR"),
    )  # fmt: skip
    notes = (
        f"{WHERE} Flips: trials whose verdict is not that of the same policy's trial of the same number from "
        "the exact start; at 0 mm, pairs of trials from one exact start whose verdicts differ.",
    )
    return [Table("borne", "How much start error a verdict bears", columns, tuple(rows), notes)]


def _verdicts(records: Sequence[dict[str, Any]], names: Sequence[str], offset_mm: float) -> dict[Any, bool]:
    kept = [r for r in records if r["policy"] in names and r["offset_mm"] == offset_mm]
    return {(r["policy"], r["point"], r["repeat"]): r["success"] for r in kept}


def _flips(records: Sequence[dict[str, Any]], names: Sequence[str], offset_mm: float) -> float:
    own, exact = (_verdicts(records, names, o) for o in (offset_mm, 0.0))
    return float(np.mean([success != exact[key] for key, success in own.items()]))


def _differ(records: Sequence[dict[str, Any]], names: Sequence[str]) -> float:
    own = _verdicts(records, names, 0.0)
    return float(np.mean([own[n, p, 0] != own[n, p, 1] for n, p, repeat in own if repeat == 0]))


def figure(records: Sequence[dict[str, Any]], exact: Sequence[dict[str, Any]]) -> bytes:
    """SVG: estimated against true error of the standard set-up, and RSR against the puck's offset."""
    standard = [r for r in records if r["setup"] == next(iter(SETUPS))]
    with drawing() as subplots:
        plot, (left, right) = subplots(10.0, 4.0, ncols=2)
        true, found = ([r[k] for r in standard] for k in ("true_mm", "estimate_mm"))
        left.plot([0, 30], [0, 30], color=LINE)
        left.plot(true, found, "o", ms=3, color=colour(0), alpha=0.6)
        left.set_xlabel("true error of placing, mm (simulated lab)")
        left.set_ylabel("estimated, mm")
        for k, name in enumerate(POLICIES):
            offsets = (0.0, *OFFSETS_MM)
            rates = [mean_rate(exact_rates(exact, [name], o)) for o in offsets]
            value, low, high = (
                100 * np.array([getattr(r, p) for r in rates]) for p in ("value", "low", "high")
            )
            right.errorbar(
                offsets, value, [value - low, high - value], color=colour(k), marker=marker(k), ls=dash(k),
                capsize=3, label=name,
            )  # fmt: skip
        right.set_xlabel("puck off by, mm (simulated lab)")
        right.set_ylabel("RSR, %")
        right.set_ylim(0, 100)
        right.legend(loc="upper right")
    return svg_of(plot)


def write(out: Path, tables: Sequence[Table]) -> None:
    """Prints tables and writes them as Markdown."""
    from lerobot_roborecover.analysis.tables import to_markdown, to_text

    out.mkdir(parents=True, exist_ok=True)
    for table in tables:
        (out / f"{table.name}.md").write_text(to_markdown(table), encoding="utf-8")
        print(to_text(table))
