"""The demo's page: the report of its trial log, with a word on what it shows and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import Study, read_study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.pages.report import Extras, write_report
from lerobot_roborecover.logs.row import TrialRow

INTRODUCTION = (
    "Each scenario replays a recorded rollout up to the point where it had gone wrong, and hands the scene "
    "to the policy, which is to finish the original task. The same policy also starts from each task's "
    "initial state. What a policy reaches from the one says little about the other.",
)


def write_page(
    log: Path,
    out: Path,
    *,
    wanted: Callable[[TrialRow], bool],
    trials: int,
    frames: Mapping[str, Path],
    problem: str,
    commands: Sequence[str],
) -> Path:
    """Writes the report of a demo.

    Args:
        log: the trial log.
        out: folder of the report's files.
        wanted: which of the log's trials the demo was asked for.
        trials: scheduled for each scenario from each start.
        frames: JPEG files by scenario id.
        problem: why some frames are missing; empty when none is.
        commands: command lines that made the trials.

    Returns:
        The page.
    """
    study = _part(read_study([str(log)]), wanted)
    extras = Extras(
        frames={name: path.read_bytes() for name, path in frames.items()},
        remarks=(f"pictures are missing: {problem}",) if problem else (),
        title="RoboRecover demo",
        introduction=INTRODUCTION,
        commands=tuple(commands),
    )
    return write_report(analyse(study, Options(scheduled=trials)), out, extras).html


def _part(study: Study, wanted: Callable[[TrialRow], bool]) -> Study:
    arms = [replace(arm, rows=tuple(filter(wanted, arm.rows))) for arm in study.arms]
    return replace(study, arms=tuple(arm for arm in arms if arm.rows))
