"""Validates a scenario dataset by replay and writes those scenarios that pass.

The working folder (`OUT.replays`) holds what every replay gave (`replays.jsonl`), the contact sheets with
their page, and what people decided on looking at them (`rejects.jsonl`). A rerun replays only what is new.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.build.candidates import CandidateSet, read_candidates
from lerobot_roborecover.build.film import Film, read_film
from lerobot_roborecover.build.funnel import STAGES, Decision, read_decisions
from lerobot_roborecover.build.isolated import Crash, run_isolated
from lerobot_roborecover.build.journal import Journal
from lerobot_roborecover.build.policy_trials import TRIALS_FILE, PolicyTrial, read_trials
from lerobot_roborecover.build.stage_dataset import write_stage
from lerobot_roborecover.build.validate.originals import OriginalFrames
from lerobot_roborecover.build.validate.replay import DrawnRun, ReplayJob, Rollout, replay_job
from lerobot_roborecover.build.validate.sheets import write_page
from lerobot_roborecover.build.validate.validation import (
    CRASH,
    Replays,
    ValidationRule,
    draw_runs,
    judge,
    replays_from,
)
from lerobot_roborecover.datasets.frames import KEPT
from lerobot_roborecover.datasets.new_folder import check_new
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.env.options import OptionError
from lerobot_roborecover.env.trial_log import TrialRow
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError, Start
from lerobot_roborecover.versions import REQUIRED, installed

VALIDATION_FILE = "validation.json"
REPLAYS_FILE, REJECTS_FILE, PAGE_FILE = "replays.jsonl", "rejects.jsonl", "index.html"
_SCHEMA = 1
_RUN_OPTIONS = ("action_mode",)
"""Simulator options that a policy's trials may have had of their own and that decide what actions mean."""

_FILM_OPTIONS = (
    "obs_type", "observation_height", "observation_width", "observation_size", "render_quality",
    "camera_name", "camera_names", "camera_name_mapping",
)  # fmt: skip
"""Simulator options that decide pictures alone: all that a dataset may choose here."""


@dataclass(frozen=True)
class ValidationRequest:
    """What to validate and how."""

    dataset: Path
    """Folder of the scenario dataset."""
    trials_folder: Path
    """As `screen` left it: one folder a policy."""
    out: Path
    """Folder of the new dataset; an earlier validation's that nothing was made of is replaced."""
    candidates: Sequence[Path] = ()
    """Candidate datasets that the scenarios were made from: original poses and frames."""
    rule: ValidationRule = field(default_factory=ValidationRule)
    env: Sequence[str] = ()
    """`name=value` options of the recovery env type: as the originals were rendered."""
    rejects: Mapping[str, str] = field(default_factory=dict)
    """Reasons by id of scenarios that a person rejects."""
    accepts: Sequence[str] = ()
    """Ids whose rejection a person takes back."""
    by: str = "a person"
    """Who looked; goes into the decisions."""
    workers: int = 1
    limit_s: float = 900.0
    """Longest that all replays of one scenario may take."""
    work: Path | None = None
    """Working folder; None takes `OUT.replays`."""

    @property
    def folder(self) -> Path:
        """The working folder."""
        return self.work or self.out.with_name(f"{self.out.name}.replays")


@dataclass(frozen=True)
class Validation:
    """What a validation gave."""

    replays: Mapping[str, Replays]
    """By scenario id."""
    decisions: Sequence[Decision]
    """On every scenario, those of people included."""
    page: Path
    """Of the contact sheets."""


def validate_dataset(
    request: ValidationRequest, progress: Callable[[int, int], None] = lambda done, total: None
) -> Validation:
    """Replays what was not replayed yet, judges, draws the page, and writes.

    Args:
        request: what and how.
        progress: called with the numbers of scenarios done and in all.

    Raises:
        ScenarioError: the request makes no sense, originals are missing, or no scenario passes.
        OptionError: an option of the env type cannot be used.
    """
    check_replaceable(request.out)
    if request.rule.frames and importlib.util.find_spec("skimage") is None:
        raise OptionError(
            "frames are compared with scikit-image, which is not installed: pip install "
            "'lerobot_env_roborecover[build]', or go without: --no-frames"
        )
    scenarios, manifest = read_with_manifest(request.dataset)
    trials = read_screening(request.trials_folder)
    sets = [read_candidates(path) for path in request.candidates]
    originals = OriginalFrames(request.dataset, sets, request.rule.frames)
    jobs = make_jobs(request, scenarios, trials, sets, originals)
    replays = replay_all(request, scenarios, jobs, originals, progress)
    rejected = _people(request, {s.id for s in scenarios})
    decisions = {s.id: judge(s.id, replays[s.id], request.rule) for s in scenarios}
    final = {i: _with_person(d, rejected.get(i)) for i, d in decisions.items()}
    page = request.folder / PAGE_FILE
    command = (
        f"roborecover validate {request.dataset} --trials-folder {request.trials_folder} --out "
        f"{request.out} ... --reject ID --reason TEXT"
    )
    write_page(page, scenarios, replays, final, request.rule, command)
    kept = [_validated(s, replays[s.id], request) for s in scenarios if final[s.id].verdict == "kept"]
    record = {
        "rule": asdict(request.rule), "env": list(request.env), "frames": _frames_note(replays.values()),
        "passed": len(kept), "validated": len(scenarios), "versions": _versions(manifest["platform"]),
    }  # fmt: skip
    both = [*decisions.values(), *(final[i] for i in rejected if final[i] != decisions[i])]
    _write(request, kept, both, record, manifest)
    return Validation(replays, list(final.values()), page)


def read_screening(folder: Path) -> dict[tuple[str, str], list[tuple[str, PolicyTrial]]]:
    """Trials from recovery points by scenario id and hash, each with its policy's name, by name and trial.

    Raises:
        ScenarioError: there are none.
    """
    found: dict[tuple[str, str], list[tuple[str, PolicyTrial]]] = {}
    logs = sorted(folder.glob(f"*/{TRIALS_FILE}"))
    if not logs:
        raise ScenarioError(
            f"{folder} holds no trials (NAME/{TRIALS_FILE}); name the folder that roborecover screen kept "
            "them in, usually OUT.trials"
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
    trials: Mapping[tuple[str, str], Sequence[tuple[str, PolicyTrial]]],
    sets: Sequence[CandidateSet],
    originals: OriginalFrames,
) -> dict[str, ReplayJob]:
    """What to replay of each scenario, by id; the original frames come when its turn does.

    Raises:
        ScenarioError: no scenario has a trial, or frames to compare with are missing.
    """
    if not any((s.id, s.sha256()) in trials for s in scenarios):
        raise ScenarioError(
            f"{request.trials_folder} holds no trial of the scenarios of {request.dataset}; name the folder "
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
        rollout, film = _rollout(scenario, sets)
        mine = {**options, **_film_options(film, request)}
        job = ReplayJob(
            scenario,
            tuple(_drawn(name, t, mine) for name, t in drawn),
            mine,
            rollout,
            sheet=request.folder / "sheets" / f"{scenario.id}.png" if request.rule.frames else None,
        )
        jobs[scenario.id] = replace(job, key=_key(job, originals.identity(scenario)))
    return jobs


def simulator_options(platform: str, request: ValidationRequest, originals: OriginalFrames) -> dict[str, Any]:
    """Options of the simulators: as the originals were rendered, or without pictures.

    Raises:
        OptionError: an option cannot be used.
    """
    from lerobot_roborecover.build.policy_trials import env_config

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
        if platform == "fake" and "obs_type" not in named:
            given.append("obs_type=pixels_agent_pos")
    return dict(env_config(platform, str(request.dataset), [f"--{o}" for o in given]).run_spec().slot.options)


def replay_all(
    request: ValidationRequest,
    scenarios: Sequence[Scenario],
    jobs: Mapping[str, ReplayJob],
    originals: OriginalFrames,
    progress: Callable[[int, int], None],
) -> dict[str, Replays]:
    """Replays by scenario id; those of the journal are not done again."""
    found: dict[str, Replays] = {}
    with Journal(request.folder / REPLAYS_FILE, _SCHEMA) as journal:
        known = {r["key"]: r for r in journal.records}
        todo = []
        for scenario in scenarios:
            job = jobs[scenario.id]
            entry = known.get(job.key)
            if len(job.runs) < request.rule.runs:
                found[scenario.id] = Replays()
            elif entry is not None and (job.sheet is None or entry["replays"]["error"] or job.sheet.exists()):
                found[scenario.id] = replays_from(entry["replays"])
            else:
                todo.append(job)
        progress(len(found), len(scenarios))
        ready = (replace(job, originals=originals.of(job.scenario)) for job in todo)
        for job, result in run_isolated(replay_job, ready, request.workers, request.limit_s):
            if isinstance(result, Crash):
                if result.reason.startswith("ScenarioError"):  # a request that cannot be met
                    raise ScenarioError(f"scenario {job.scenario.id}: {result.reason.partition(': ')[2]}")
                result = Replays(error=result.reason, error_kind=CRASH)
            journal.append({"key": job.key, "id": job.scenario.id, "replays": asdict(result)})
            found[job.scenario.id] = result
            progress(len(found), len(scenarios))
    return found


def check_replaceable(out: Path) -> None:
    """Checks that a dataset can be written: its folder is new or empty, or holds an earlier validation that
    nothing rests on.

    Raises:
        ScenarioError: it is something else.
    """
    if not (out / FOLDER / VALIDATION_FILE).is_file():
        check_new(out)
        return
    later = STAGES[STAGES.index("validate") + 1 :]
    if (out / "data").exists() or any(d.stage in later for d in read_decisions(out)):
        raise ScenarioError(
            f"{out} was validated before, and then divided or rendered: results may rest on it. Name a new "
            "--out"
        )


def _write(
    request: ValidationRequest,
    kept: Sequence[Scenario],
    decisions: Sequence[Decision],
    record: Mapping[str, Any],
    manifest: Mapping[str, Any],
) -> None:
    """Writes the dataset beside its place, and then puts it there."""
    temporary = request.out.with_name(f".{request.out.name}.{os.getpid()}.new")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        write_stage(temporary, request.dataset, kept, decisions, (VALIDATION_FILE, record), manifest)
        if request.out.exists():
            old = request.out.with_name(f".{request.out.name}.{os.getpid()}.old")
            os.replace(request.out, old)
            os.replace(temporary, request.out)
            shutil.rmtree(old)
        else:
            os.replace(temporary, request.out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _drawn(name: str, trial: PolicyTrial, options: Mapping[str, Any]) -> DrawnRun:
    row: TrialRow = trial.row
    own = {k: row.options[k] for k in _RUN_OPTIONS if k in row.options and row.options[k] != options.get(k)}
    return DrawnRun(name, row.trial, trial.actions, row.success, row.options.get("control_mode"), own)


def _film_options(film: Film, request: ValidationRequest) -> dict[str, Any]:
    """Simulator options that a rollout was filmed with, but for those that the request names itself."""
    if not request.rule.frames:
        return {}
    named = {option.split("=")[0] for option in request.env}
    return {k: v for k, v in film.options.items() if k in _FILM_OPTIONS and k not in named}


def _rollout(scenario: Scenario, sets: Sequence[CandidateSet]) -> tuple[Rollout | None, Film]:
    """The rollout that a scenario was made from, around its recovery point, and how it was filmed."""
    from lerobot_roborecover.build.validate.frames import TAIL

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
        film = read_film(found.row(episode).provenance, f"{found.root}: candidate {scenario.id}")
        poses = {s: steps.poses_at(s) for s in around}
        return Rollout(poses, actions[step:last], len(actions), film.every), film
    return None, Film()


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
        job.rollout.film_every if job.rollout else 1,
        job.scenario.sha256(), poses, around, runs, dict(job.options), originals,
        _versions(job.scenario.platform),
    ]  # fmt: skip
    digest.update(json.dumps(head, sort_keys=True, default=str).encode())
    for run in job.runs:
        digest.update(run.actions.tobytes())
    if job.rollout is not None:
        digest.update(job.rollout.after.tobytes())
    return digest.hexdigest()


def _versions(platform: str) -> dict[str, str]:
    return {name: installed(name) or "" for name in REQUIRED.get(platform, {})}


def _people(request: ValidationRequest, ids: set[str]) -> dict[str, dict[str, Any]]:
    """Rejections that stand, by id, after this request's own are on record.

    Raises:
        ScenarioError: an id is unknown, or a rejection has no reason.
    """
    for one, reason in [*request.rejects.items(), *((i, "-") for i in request.accepts)]:
        if one not in ids:
            raise ScenarioError(f"{one!r:.140} is no scenario of {request.dataset}; check the id")
        if not reason.strip():
            raise ScenarioError(f"rejecting {one} needs a reason: --reason TEXT")
    with Journal(request.folder / REJECTS_FILE, _SCHEMA) as journal:
        standing = {r["id"]: r for r in journal.records if r["id"] in ids}
        new = [{"id": i, "rejected": True, "reason": r, "by": request.by} for i, r in request.rejects.items()]
        new += [{"id": i, "rejected": False, "reason": "", "by": request.by} for i in request.accepts]
        keys = ("rejected", "reason")
        fresh = [r for r in new if any(standing.get(r["id"], {}).get(k) != r[k] for k in keys)]
        if fresh:
            journal.append(*fresh)
        standing |= {r["id"]: r for r in fresh}
    return {i: r for i, r in standing.items() if r["rejected"]}


def _with_person(decision: Decision, rejection: Mapping[str, Any] | None) -> Decision:
    if rejection is None or decision.verdict != "kept":
        return decision
    reason = "rejected on inspection"
    return Decision(decision.candidate, "validate", "dropped", reason, rejection["reason"], rejection["by"])


def _validated(scenario: Scenario, replays: Replays, request: ValidationRequest) -> Scenario:
    note = {
        "runs": [f"{r.policy} trial {r.trial}" for r in replays.runs],
        "seed": request.rule.seed,
        "eef_mm": replays.eef_mm,
        "object_mm": replays.object_mm,
        "frames": replays.frames,
        "identical_state": replays.identical,
    }
    if request.rule.frames:
        note["mean_ssim"] = replays.mean_ssim
    return replace(scenario, provenance={**scenario.provenance, "validation": note})


def _frames_note(replays: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    for found in replays:
        counts[found.frames] = counts.get(found.frames, 0) + 1
    return counts
