"""Validates a scenario dataset by replay and writes those scenarios that pass.

The working folder (`OUT.replays`) holds what every replay gave (`replays.jsonl`), the contact sheets with
their page, and what people decided on looking at them (`rejects.jsonl`). A rerun replays only what is new.
"""

from __future__ import annotations

import importlib.util
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.funnel import (
    STAGES,
    Decision,
    attrition_table,
    count_stages,
    read_decisions,
)
from lerobot_roborecover.curation.stage_dataset import write_stage
from lerobot_roborecover.curation.validate.jobs import make_jobs, read_screening, simulator_versions
from lerobot_roborecover.curation.validate.originals import OriginalFrames
from lerobot_roborecover.curation.validate.replay import ReplayJob, ReplayReport, replay_job
from lerobot_roborecover.curation.validate.request import ValidationRequest
from lerobot_roborecover.curation.validate.sheets import write_page
from lerobot_roborecover.curation.validate.validation import (
    CRASH,
    Replays,
    format_validation,
    judge,
    replays_from,
)
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.video_frames import check_frames
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write, check_new
from lerobot_roborecover.utils.journal import Journal
from lerobot_roborecover.utils.text import install_command, next_command
from lerobot_roborecover.workers.jobs import Done, JobPool, Outcome
from lerobot_roborecover.workers.messages import SlotFailure

VALIDATION_FILE = "validation.json"
REPLAYS_FILE, REJECTS_FILE, PAGE_FILE = "replays.jsonl", "rejects.jsonl", "index.html"
_SCHEMA = 1


@dataclass(frozen=True)
class Validation:
    replays: Mapping[str, Replays]
    """Replays by scenario id."""
    decisions: Sequence[Decision]
    """On every scenario, those of people included."""
    page: Path
    """Page of the contact sheets."""


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
    request.workplace.check()
    screening, rejects = request.trials, request.rejects  # refused before hours of replays
    check_replaceable(request.out)
    if request.rule.frames and importlib.util.find_spec("skimage") is None:
        raise OptionError(
            "frames are compared with scikit-image, which is not installed: "
            f"{install_command('build')}, or go without: --no-frames"
        )
    scenarios, manifest = read_with_manifest(request.dataset)
    sets = [read_candidates(path) for path in request.candidates]
    for found in sets:
        check_frames(found.root, [row.steps for row in found.trajectories.rows], thorough=True)
    check_frames(Path(request.dataset), [len(s.prefix) for s in scenarios], thorough=True)
    trials = read_screening(screening)
    originals = OriginalFrames(request.dataset, sets, request.rule.frames)
    jobs = make_jobs(request, scenarios, trials, sets, originals)
    replays = replay_all(request, scenarios, jobs, originals, progress)
    rejected = _people(request, rejects, {s.id for s in scenarios})
    decisions = {s.id: judge(s.id, replays[s.id], request.rule) for s in scenarios}
    final = {i: _with_person(d, rejected.get(i)) for i, d in decisions.items()}
    page = request.folder / PAGE_FILE
    command = f"roborecover {shlex.join(reject_next(request))}"
    write_page(page, scenarios, replays, final, request.rule, command)
    kept = [_validated(s, replays[s.id], request) for s in scenarios if final[s.id].verdict == "kept"]
    record = {
        "rule": asdict(request.rule), "env": list(request.env), "frames": _frames_note(replays.values()),
        "passed": len(kept), "validated": len(scenarios),
        "versions": simulator_versions(manifest["platform"]),
    }  # fmt: skip
    both = [*decisions.values(), *(final[i] for i in rejected if final[i] != decisions[i])]
    _write(request, kept, both, record, manifest)
    return Validation(replays, list(final.values()), page)


def describe(request: ValidationRequest, made: Validation) -> str:
    """Returns the result as text: the distribution, the funnel, and the command that follows."""
    return "\n".join(
        (
            format_validation(made.replays, made.decisions, request.rule) + "\n",
            attrition_table(count_stages(read_decisions(request.out))),
            f"\n{request.out}\nlook at {made.page}, worst first; --reject ID --reason TEXT takes one out",
            next_command(
                ["curate", "split", str(request.out), "--train", "0.8", "--test", "0.2", "--out", "SPLIT"]
            ),
        )
    )


def reject_next(request: ValidationRequest) -> list[str]:
    """Arguments of the same validation with one scenario rejected."""
    rule = request.rule
    argv = ["curate", "validate", str(request.dataset), "--trials-folder", str(request.trials)]
    argv += [w for path in request.candidates for w in ("--candidates", str(path))]
    argv += [w for option in request.env for w in ("--env", option)]
    argv += ["--runs", str(rule.runs), "--seed", str(rule.seed)]
    argv += ["--tolerance-mm", f"{rule.tolerance_mm:g}", "--min-ssim", f"{rule.min_ssim:g}"]
    argv += ["--no-frames"] * (not rule.frames) + ["--no-outcomes"] * (not rule.outcomes)
    argv += ["--work", str(request.work)] if request.work else []
    return [*argv, "--out", str(request.out), "--reject", "ID", "--reason", "TEXT"]


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
            elif entry is not None and (
                not job.sheet or entry["replays"]["error"] or request.sheet(scenario.id).exists()
            ):
                found[scenario.id] = replays_from(entry["replays"])
            else:
                todo.append(job)
        progress(len(found), len(scenarios))
        todo.sort(key=lambda job: job.scenario.task.name)  # a process keeps the tasks that it has compiled
        ready = (replace(job, originals=originals.of(job.scenario)) for job in todo)
        platform = scenarios[0].platform if len(scenarios) else ""
        with JobPool(
            platform, workers=request.workers, limit_s=request.limit_s, workplace=request.workplace
        ) as pool:
            for job, outcome in pool.outcomes(replay_job, ready, lambda job: (job,)):
                report = _report_of(job, outcome)
                result = report.replays
                if report.sheet:
                    atomic_write(request.sheet(job.scenario.id), report.sheet)
                if not (isinstance(outcome, SlotFailure) and outcome.kind == "lost"):
                    journal.append({"key": job.key, "id": job.scenario.id, "replays": asdict(result)})
                found[job.scenario.id] = result
                progress(len(found), len(scenarios))
    return found


def _report_of(job: ReplayJob, outcome: Outcome) -> ReplayReport:
    """What a job came to.

    Raises:
        ScenarioError: what is asked for cannot be met.
    """
    if isinstance(outcome, Done):
        return outcome.value
    if isinstance(outcome, SlotFailure):
        return ReplayReport(Replays(error=outcome.message, error_kind=CRASH))
    if isinstance(outcome.error, ScenarioError):
        raise ScenarioError(f"scenario {job.scenario.id}: {outcome.error}")
    return ReplayReport(Replays(error=outcome.words, error_kind=CRASH))


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
    with atomic_dir(request.out, replace=True) as folder:
        write_stage(folder, request.dataset, kept, decisions, (VALIDATION_FILE, record), manifest)


def _people(
    request: ValidationRequest, rejects: Mapping[str, str], ids: set[str]
) -> dict[str, dict[str, Any]]:
    """Rejections that stand, by id, after this request's own are on record.

    Raises:
        ScenarioError: an id is unknown, or a rejection has no reason.
    """
    for one, reason in [*rejects.items(), *((i, "-") for i in request.accepts)]:
        if one not in ids:
            raise ScenarioError(f"{one!r:.140} is no scenario of {request.dataset}; check the id")
        if not reason.strip():
            raise ScenarioError(f"rejecting {one} needs a reason: --reason TEXT")
    with Journal(request.folder / REJECTS_FILE, _SCHEMA) as journal:
        standing = {r["id"]: r for r in journal.records if r["id"] in ids}
        new = [{"id": i, "rejected": True, "reason": r, "by": request.by} for i, r in rejects.items()]
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
    return replace(
        scenario, provenance={**scenario.provenance, "validation": note}, fingerprint=replays.mark(scenario)
    )


def _frames_note(replays: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    for found in replays:
        counts[found.frames] = counts.get(found.frames, 0) + 1
    return counts
