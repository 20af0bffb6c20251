"""What a validation replays: each scenario's drawn screening runs and, where it is known, its rollout."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.candidates import CandidateSet
from lerobot_roborecover.curation.policy_trials import TRIALS_FILE, env_config, read_trials
from lerobot_roborecover.curation.validate.frames import TAIL
from lerobot_roborecover.curation.validate.originals import OriginalFrames
from lerobot_roborecover.curation.validate.replay import DrawnRun, OriginalRollout, ReplayJob
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.curation.validate.validation import draw_runs
from lerobot_roborecover.curation.video_settings import VideoSettings, read_video_settings
from lerobot_roborecover.datasets.frames import KEPT
from lerobot_roborecover.logs.row import LoggedTrial, TrialRow
from lerobot_roborecover.platforms.versions import installed, required
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError, Start

_RUN_OPTIONS = ("action_mode",)
"""Simulator options that a policy's trials may have had of their own and that decide what actions mean."""

_RENDER_OPTIONS = (
    "obs_type", "observation_height", "observation_width", "observation_size", "render_quality",
    "camera_name", "camera_names", "camera_name_mapping",
)  # fmt: skip
"""Simulator options that decide pictures alone: all that a dataset may choose here."""


def read_screening(folder: Path) -> dict[tuple[str, str], list[tuple[str, LoggedTrial]]]:
    """Trials from recovery points by scenario id and hash, each with its policy's name, by name and trial.

    Raises:
        ScenarioError: there are none.
    """
    found: dict[tuple[str, str], list[tuple[str, LoggedTrial]]] = {}
    logs = sorted(folder.glob(f"*/{TRIALS_FILE}"))
    if not logs:
        raise ScenarioError(
            f"{folder} holds no trials (NAME/{TRIALS_FILE}); name the folder that roborecover curate screen "
            "kept them in, usually OUT.trials"
        )
    for log in logs:
        for trial in read_trials(log.parent):
            row = trial.row
            if row.start == Start.RECOVERY.value and not row.interventions:
                found.setdefault((row.scenario_id, row.scenario_sha256), []).append((log.parent.name, trial))
    for each in found.values():
        each.sort(key=lambda item: (item[0], item[1].row.trial, item[1].row.config_hash))
    return found


def make_jobs(
    request: ValidationRequest,
    scenarios: Sequence[Scenario],
    trials: Mapping[tuple[str, str], Sequence[tuple[str, LoggedTrial]]],
    sets: Sequence[CandidateSet],
    originals: OriginalFrames,
) -> dict[str, ReplayJob]:
    """What to replay of each scenario, by id; the original frames come when its turn does.

    Raises:
        ScenarioError: no scenario has a trial, or frames to compare with are missing.
    """
    if not any((s.id, s.sha256()) in trials for s in scenarios):
        raise ScenarioError(
            f"{request.trials} holds no trial of the scenarios of {request.dataset}; name the folder "
            "of their own screening"
        )
    options = simulator_options(scenarios[0].platform, request, originals)
    jobs = {}
    for scenario in scenarios:
        valid = [
            (name, t)
            for name, t in trials.get((scenario.id, scenario.sha256()), ())
            if Outcome(t.row.outcome).valid
        ]
        drawn = draw_runs(scenario.id, valid, request.rule)
        rollout, video = _rollout(scenario, sets)
        mine = {**options, **_render_options(video, request)}
        job = ReplayJob(
            scenario,
            tuple(_drawn(name, t, mine) for name, t in drawn),
            mine,
            rollout,
            sheet=request.rule.frames,
        )
        jobs[scenario.id] = replace(job, key=_key(job, originals.identity(scenario)))
    return jobs


def simulator_options(platform: str, request: ValidationRequest, originals: OriginalFrames) -> dict[str, Any]:
    """Options of the simulators: as the originals were rendered, or without pictures.

    Raises:
        OptionError: an option cannot be used.
    """
    given = list(request.env)
    named = {option.split("=")[0] for option in given}
    config = env_config(platform, str(request.dataset), [f"--{o}" for o in given])
    if not request.rule.frames and "obs_type" not in named:
        given.append("obs_type=state")
    elif request.rule.frames:
        size = originals.size()
        for name, pixels in zip(("observation_height", "observation_width"), size or (), strict=False):
            if hasattr(config, name) and name not in named:
                given.append(f"{name}={pixels}")
        if not config.has_pictures and "obs_type" not in named:
            given.append("obs_type=pixels_agent_pos")
    return dict(env_config(platform, str(request.dataset), [f"--{o}" for o in given]).run_spec().slot.options)


def _drawn(name: str, trial: LoggedTrial, options: Mapping[str, Any]) -> DrawnRun:
    row: TrialRow = trial.row
    own = {k: row.options[k] for k in _RUN_OPTIONS if k in row.options and row.options[k] != options.get(k)}
    return DrawnRun(name, row.trial, trial.actions, row.success, row.options.get("control_mode"), own)


def _render_options(video: VideoSettings, request: ValidationRequest) -> dict[str, Any]:
    """Simulator options that a rollout was rendered with, but for those that the request names itself."""
    if not request.rule.frames:
        return {}
    named = {option.split("=")[0] for option in request.env}
    return {k: v for k, v in video.options.items() if k in _RENDER_OPTIONS and k not in named}


def _rollout(
    scenario: Scenario, sets: Sequence[CandidateSet]
) -> tuple[OriginalRollout | None, VideoSettings]:
    """The rollout that a scenario was made from, around its recovery point, and how it was rendered."""
    for found in sets:
        episode = found.by_id.get(scenario.id)
        if episode is None:
            continue
        step, actions, steps = len(scenario.prefix), found.actions(episode), found.steps(episode)
        if len(actions) <= step or not np.array_equal(actions[:step], scenario.prefix):
            raise ScenarioError(
                f"scenario {scenario.id}: its prefix of {step} actions is not the beginning of its "
                f"rollout in {found.root}; name the candidates that it was made from"
            )
        last = min(step + TAIL, len(actions))
        around = range(max(step - KEPT + 1, 0), last + 1)
        video = read_video_settings(found.row(episode).provenance, f"{found.root}: candidate {scenario.id}")
        poses = {s: steps.poses_at(s) for s in around}
        return OriginalRollout(poses, actions[step:last], len(actions), video.every), video
    return None, VideoSettings()


def _key(job: ReplayJob, originals: str) -> str:
    """What decides a scenario's replays."""
    digest = hashlib.sha256()
    mark = job.scenario.fingerprint
    poses = {n: [*p.position_m, *p.quat_xyzw] for n, p in (mark.bodies if mark else {}).items()}
    around = {
        s: {n: [*p.position_m, *p.quat_xyzw] for n, p in found.items()}
        for s, found in (job.rollout.poses if job.rollout else {}).items()
    }
    runs = [
        (r.policy, r.trial, r.success, r.control_mode, dict(r.options), str(r.actions.dtype))
        for r in job.runs
    ]
    head = [
        job.rollout.frame_stride if job.rollout else 1,
        job.scenario.sha256(), poses, around, runs, dict(job.options), originals,
        simulator_versions(job.scenario.platform),
    ]  # fmt: skip
    digest.update(json.dumps(head, sort_keys=True, default=str).encode())
    for run in job.runs:
        digest.update(run.actions.tobytes())
    if job.rollout is not None:
        digest.update(job.rollout.after.tobytes())
    return digest.hexdigest()


def simulator_versions(platform: str) -> dict[str, str]:
    """Of the packages that decide what a replay gives."""
    return {name: installed(name) or "" for name in required(platform)}
