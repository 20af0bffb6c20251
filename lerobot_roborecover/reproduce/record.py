"""What a reproduction leaves: a page to read and to send, and the same numbers for a program."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_roborecover._version import __version__
from lerobot_roborecover.analysis.stats.agreement import AgreementVerdict, ScoreAgreement
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.tables import Cell, Column, Table, to_markdown
from lerobot_roborecover.reproduce.arms import (
    INITIAL,
    RECOVERY,
    ArmResult,
    ReproductionPlan,
    ReproductionResult,
)
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import check_page
from lerobot_roborecover.workers.capacity import usable_cores
from lerobot_roborecover.workers.render_device import egl_devices

SCHEMA = 1
MARKDOWN, JSON = "reproduction.md", "reproduction.json"


def write_record(result: ReproductionResult) -> tuple[Path, Path]:
    """Writes both files into the plan's folder; returns their paths."""
    out = result.plan.out
    check_record(result.plan)
    atomic_write(out / JSON, json.dumps(_plain(record(result)), indent=1, ensure_ascii=False) + "\n")
    atomic_write(out / MARKDOWN, page(result))
    return out / MARKDOWN, out / JSON


def check_record(plan: ReproductionPlan) -> None:
    """Checks that the plan's folder holds no record of another reproduction.

    Raises:
        OutputExistsError: it does.
    """

    def made_here(path: Path) -> bool:
        try:
            return json.loads(path.read_bytes())["name"] == plan.checkpoint.name
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return False

    check_page(plan.out, (JSON, MARKDOWN), made_here)


def verdict(result: ReproductionResult) -> str:
    """The result in words: what the initial arm allows to be said of the recovery arm."""
    check, margin = result.check, 100 * result.plan.margin
    ours, theirs = (_percent(e) for e in (check.measured, check.published))
    gap = f"{_percent(check.difference, sign=True)} points"
    if check.standing is AgreementVerdict.UNMEASURED:
        why = ", ".join(f"{count} {outcome}" for outcome, count in result.initial.summary.invalid.items())
        return (
            f"**Not measured.** Every trial from initial states was invalid ({why}), so there is no rate to "
            "hold against what is published. Find the cause first: roborecover check policy, and the reasons "
            "in the trial log."
        )
    if check.standing is AgreementVerdict.UNPUBLISHED:
        return (
            f"**Not confirmed.** Initial states {ours} %. No score is published to hold this against, so "
            "nothing shows that the policy is set up as its makers had it."
        )
    said = f"Initial states {ours} % here, {theirs} % published: {gap}."
    if check.standing is AgreementVerdict.LOWER:
        end = (
            "The recovery arm was run all the same (--force); do not take it for this policy's."
            if result.recovery
            else "The recovery arm was not run: find the cause first (roborecover check policy; "
            "docs/policies.md), or say --force."
        )
        return f"**Not reproduced.** {said} The interval leaves zero out. {end}"
    if check.standing is AgreementVerdict.UNDECIDED:
        return (
            f"**Not confirmed.** {said} No difference is shown, but a loss of {margin:g} points could hide "
            "in so few trials. More scenarios or trials narrow the interval."
        )
    if check.standing is AgreementVerdict.HIGHER:
        return f"**Confirmed.** {said} It is above; the tasks may be easier ones than those published on."
    return f"**Confirmed.** {said} A loss of {margin:g} points would have been seen."


def page(result: ReproductionResult) -> str:
    """The report in Markdown."""
    plan, checkpoint = result.plan, result.plan.checkpoint
    row = result.initial.rows[0]
    lines = [f"# Reproduction: {checkpoint.name}", "", verdict(result), "", to_markdown(_scores(result))]
    lines += [to_markdown(_work(result))]
    lines += ["## What was run", "", f"- policy: {row.policy}"]
    if checkpoint.checkpoint:
        lines += [f"- checkpoint of that name: {checkpoint.checkpoint}; {checkpoint.weights}"]
    lines += [f"- scenarios: {result.scenarios} of {row.dataset}, revision {row.dataset_revision or 'none'}"]
    versions = [f"{name} {version}" for name, version in sorted(row.versions.items())]
    lines += [f"- RoboRecover {__version__}; {', '.join(versions)}"]
    lines += [f"- machine: {machine()}", "", "```bash", plan.command_line(INITIAL)]
    if result.recovery is not None:
        lines += [plan.command_line(RECOVERY)]
    return "\n".join([*lines, "```", ""])


def record(result: ReproductionResult) -> dict[str, Any]:
    """The report for a program; rates in [0, 1]."""
    plan, row = result.plan, result.initial.rows[0]
    arms = [arm for arm in (result.initial, result.recovery) if arm is not None]
    return {
        "schema": SCHEMA,
        "name": plan.checkpoint.name,
        "standing": str(result.check.standing),
        "confirmed": result.confirmed,
        "margin": plan.margin,
        "policy": row.policy,
        "scenarios": {"dataset": row.dataset, "revision": row.dataset_revision, "count": result.scenarios},
        "published": None if plan.published is None else asdict(plan.published),
        "initial": _compared(result.check),
        "initial_of_makers": None if result.makers is None else _compared(result.makers[1]),
        "recovery": None if result.against_paper is None else _compared(result.against_paper),
        "arms": {arm.start: _arm(result, arm) for arm in arms},
        "versions": {"lerobot_env_roborecover": __version__, **row.versions},
        "machine": machine(),
    }


def machine() -> str:
    """What it ran on, in a line."""
    gpus = sum(not device.software for device in egl_devices())
    return f"{platform.system()} {platform.machine()}, {usable_cores()} cores, {gpus} GPUs that EGL knows"


def _scores(result: ReproductionResult) -> Table:
    compared: list[tuple[str, str, ScoreAgreement]] = []
    if result.plan.published is not None:
        published = result.plan.published
        compared += [("initial states", f"{published.source}; {published.on}", result.check)]
    if result.makers is not None:
        score, found = result.makers
        compared += [("initial states", f"{score.source}; {score.on}", found)]
    if result.against_paper is not None and not math.isnan(result.against_paper.published.value):
        compared += [("recovery (RSR)", "the paper, complete results", result.against_paper)]
    rows: list[tuple[Cell, ...]] = [
        (what, c.measured, c.published, c.difference, str(c.standing), by) for what, by, c in compared
    ]
    told = {what for what, _, _ in compared}
    for name, arm in (("initial states", result.initial), ("recovery (RSR)", result.recovery)):
        if arm is not None and name not in told:
            rows.append(
                (
                    name,
                    arm.summary.rate,
                    None,
                    None,
                    str(AgreementVerdict.UNPUBLISHED),
                    "nothing is published",
                )
            )
    return Table(
        "scores", "Scores",
        (
            Column("arm"), Column("here, %", "percent"), Column("published, %", "percent"),
            Column("difference, points", "points"), Column("standing"), Column("published by, on"),
        ),
        tuple(rows),
        ("95 % intervals. That of the difference is put together from the two rates' own (MOVER).",),
    )  # fmt: skip


def _work(result: ReproductionResult) -> Table:
    scenarios, rows = result.plan.scenarios(), []
    for arm in (result.initial, result.recovery):
        if arm is not None:
            expected = result.plan.length(arm.start, scenarios).hours
            invalid = sum(arm.summary.invalid.values())
            rows.append(
                (arm.start, arm.summary.trials, invalid, f"{expected:.2g}", f"{arm.seconds / 3600:.2g}")
            )
    columns = ("arm", "trials", "invalid", "hours expected, at most", "hours taken")
    return Table("work", "Trials and hours", tuple(Column(c) for c in columns), tuple(
        tuple(str(cell) for cell in row) for row in rows
    ))  # fmt: skip


def _arm(result: ReproductionResult, arm: ArmResult) -> dict[str, Any]:
    return {
        "rate": asdict(arm.summary.rate),
        "trials": arm.summary.trials,
        "invalid": {str(k): v for k, v in arm.summary.invalid.items()},
        "seconds": arm.seconds,
        "command": result.plan.command_line(arm.start),
        "trial_log": str(result.plan.log(arm.start)),
    }


def _compared(found: ScoreAgreement) -> dict[str, Any]:
    return {**asdict(found), "standing": str(found.standing)}


def _plain(value: Any) -> Any:
    """NaN is no JSON."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def _percent(found: Estimate, sign: bool = False) -> str:
    form = "+.1f" if sign else ".1f"
    text = f"{100 * found.value:{form}}"
    return text if math.isnan(found.low) else f"{text} [{100 * found.low:{form}}, {100 * found.high:{form}}]"
