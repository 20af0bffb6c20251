"""Lets fieldtrial (PyPI) schedule and label the trials of a plan, and takes its labels into the run's log.

fieldtrial's starting condition is a recovery point. Its command runner starts `roborecover robot run --trial`
for each trial: that puts robot and scene back on our own page, measures the start, runs the policy, and tells
by its exit status how the trial ended. fieldtrial never learns a policy's name, only our blind code.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.robot.plan import lock_plan, read_plan
from lerobot_roborecover.robot.run_journal import RunJournal
from lerobot_roborecover.scenario import Outcome, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.text import pluralize

TRIAL_ID = "FIELDTRIAL_TRIAL_ID"
"""Environment variable by which fieldtrial tells a command which trial it is."""
STUDY_FILE = "study.yaml"
_IDENTIFIER = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def write_study(plan_path: Path, run: Path, out: Path, options: Sequence[str]) -> Path:
    """Locks a plan and writes fieldtrial's study of it.

    Args:
        plan_path: points, policies, repeats and seed.
        run: folder of the run, with its lock, journal and log.
        out: folder of the study.
        options: of `roborecover robot run`: the robot's, `--rater` and others.

    Raises:
        OptionError: fieldtrial cannot take a name, or needs two policies; the study is there already.
        ScenarioError: the points cannot be read.
    """
    plan = read_plan(plan_path)
    odd = [n for n in (*plan.policies, out.name) if not _IDENTIFIER.fullmatch(n)]
    if odd:
        raise OptionError(f"fieldtrial takes letters, digits, '_', '.' and '-' in names, not {odd[0]!r:.60}")
    if len(plan.policies) < 2:
        raise OptionError(f"{plan_path} has one policy; fieldtrial compares at least two")
    if (out / STUDY_FILE).exists():
        raise OptionError(f"{out / STUDY_FILE} is there already; name another folder with --out")
    locked, points = lock_plan(plan, run)
    command = [
        "roborecover", "robot", "run", f"--plan={plan_path}", f"--out={run}", *options,
    ]  # fmt: skip
    template = shlex.join(word.replace("{", "{{").replace("}", "}}") for word in command)
    first, second, *_ = plan.policies
    study = {
        "fieldtrial": 1,
        "name": out.name,
        "task": {"instruction": points.points[0].scenario.task.instruction},
        "rubric": {
            "stages": [{"id": "done", "label": "The task is done, as the instruction says"}],
            "success": "done",
        },
        "arms": [
            {"id": name, "runner": "command", "policy": {"code": locked.codes[name]}}
            for name in plan.policies
        ],
        "conditions": {
            "factors": {"point": {"values": [p.id for p in points.points]}},
            "replicates": plan.repeats,
        },
        "design": {"type": "randomized_block", "blinding": "operator", "seed": plan.seed},
        "analysis": {"primary": {"comparison": {"treatment": second, "control": first}}},
        "runners": {
            "command": {
                "template": f"{template} --trial={{factors.point}}:{{policy.code}}",
                "success_exit_code": 0,
                "cwd": str(Path.cwd()),
            }
        },
    }
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / STUDY_FILE, yaml.safe_dump(study, sort_keys=False, allow_unicode=True))
    return out / STUDY_FILE


def take_labels(run: Path, exported: Path, say: Callable[[str], None]) -> int:
    """Takes fieldtrial's labels into a run's log, where they differ from the verdicts that it has.

    A trial that never ran, or whose policy failed, stays what it is.

    Args:
        run: folder of the run.
        exported: what `fieldtrial export --format jsonl` writes.
        say: takes lines.

    Returns:
        How many verdicts were changed.

    Raises:
        ScenarioError: the file is not such an export, or another process has the run open.
    """
    labels = _read(exported)
    journal = RunJournal(run)
    changed = 0
    try:
        orders = journal.external()
        rows = journal.rows()
        unknown = [name for name in labels if orders.get(name) not in rows]
        for name, label in labels.items():
            row = rows.get(orders.get(name, -1))
            found = None if row is None else _labelled(TrialRow(**row), label)
            if found is not None:
                journal.finish(orders[name], found)
                changed += 1
    finally:
        journal.close()
    say(f"{pluralize(len(labels), 'label')}, {pluralize(changed, 'verdict')} changed in {journal.log}")
    if unknown:
        say(f"{pluralize(len(unknown), 'trial')} of fieldtrial has no verdict here, e.g. {unknown[0]}")
    return changed


def _read(exported: Path) -> dict[str, dict[str, Any]]:
    """Finished trials by fieldtrial's id."""
    try:
        lines = [json.loads(line) for line in exported.read_text("utf-8").splitlines() if line.strip()]
        return {str(line["trial_id"]): line for line in lines if line["status"] in ("completed", "invalid")}
    except (ValueError, KeyError, TypeError) as err:
        raise ScenarioError(
            f"{exported} is not what `fieldtrial export --format jsonl` writes ({err!r:.80})"
        ) from None


def _labelled(row: TrialRow, label: dict[str, Any]) -> TrialRow | None:
    """A row with fieldtrial's label; None where it says the same, or the trial has no verdict of a person."""
    verdict = "invalid" if label["status"] == "invalid" else "success" if label["success"] else "failure"
    assert row.robot is not None
    if row.outcome in (Outcome.STATE_MISMATCH, Outcome.POLICY_ERROR) or row.robot["verdict"] == verdict:
        return None
    reason = " ".join(str(label.get("invalid_reason") or "other").split())[:2000]
    outcome = {"success": Outcome.SUCCESS, "failure": Outcome.HORIZON}.get(verdict, Outcome.SIM_ERROR)
    values = {
        **row.robot,
        "verdict": verdict,
        "rater": str(label.get("operator") or row.robot["rater"])[:256],
    }
    return replace(
        row,
        outcome=outcome,
        success=verdict == "success",
        reason=f"invalid (fieldtrial): {reason}" if verdict == "invalid" else "",
        robot=values,
    )
