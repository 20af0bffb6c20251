"""A trial as a line of the log: what the run held fixed, how it ended, and what makes it the same trial.

A row names the executed actions by their hash alone. With `--env.record_actions=true` the actions themselves
lie beside the log (`put_actions`, `read_actions`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np

from lerobot_roborecover.logs.fields import MAX_TEXT, TRIAL_SCHEMA
from lerobot_roborecover.platforms import resolve_rewind_steps
from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.scenario import Outcome, ScenarioError, TrialStart
from lerobot_roborecover.utils.atomic_io import atomic_file

ACTIONS_FOLDER = "actions"
"""Folder beside the log, of files of actions by their hash. A file is there before its row is: the trial can
then be replayed, forked (`roborecover detect fork`) and exported (`roborecover curate training-data`)."""
OPTION = "--env.record_actions=true"
"""What has a run record them."""


@dataclass(frozen=True)
class EvalProtocol:
    """What a run holds fixed for all its trials; part of every row and of the key that resumes it."""

    start: str
    """`recovery`, `initial` or `reversion`."""
    rewind_steps: int | None
    """Steps before the recovery point, for `reversion`; None follows the paper's rule by scenario. Otherwise
    0."""
    policy: str
    """Who was evaluated: path or Hub id, with a content hash or revision where known."""
    run_seed: int | None
    """Seed of the run; None where the caller gave none."""
    execution_horizon: int | None
    """Actions executed per inference (`n_action_steps`), where the policy says."""
    policy_settings: Mapping[str, Any] = field(default_factory=dict)
    """Everything about the policy beside its files that can change a result, see `TrialRow`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What else decides a result: observation size, control mode, handoff check, and the like."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Packages that decide scores."""

    def __post_init__(self):
        # A path with a decomposed letter, as some file systems give it, is the same policy.
        object.__setattr__(self, "policy", normalize("NFC", self.policy))

    def rewind_for(self, scenario: TrialStart) -> int:
        """Steps before the recovery point on this scenario, before the task's start limits them."""
        return resolve_rewind_steps(scenario, self.rewind_steps)

    def config_hash(self) -> str:
        """Short hash of everything above."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class RunExtent:
    """How much a run was to evaluate; every row says it, so that a log shows what is missing."""

    scenarios: int
    """Scenarios of the selection, over all shards."""
    trials: int | None
    """Trials per scenario; None where the caller did not say."""
    shard: str = "0/1"
    """`k/n`, k from 0, as the option has it."""


@dataclass(frozen=True, slots=True, repr=False)
class TrialRow:
    """One finished trial. Flat, so that a log loads into any table library as it is. It prints short;
    `dataclasses.asdict(row)` has all fields.

    Rows of one log share equal texts, `options` and `versions`; never change these in place.
    """

    schema: int
    """Version of this layout."""
    scenario_id: str
    scenario_sha256: str
    dataset: str
    """Where the scenario came from."""
    dataset_revision: str | None
    platform: str
    suite: str
    task: str
    instruction: str
    stage: str
    deviation: str
    source: str
    source_policy: str
    cluster: str
    split: str
    start: str
    rewind_steps: int
    """Steps before the recovery point that were asked for; a shorter prefix starts at its beginning."""
    handoff_step: int
    """Prefix actions replayed before the policy took over."""
    trial: int
    """k: index of the trial within its scenario, from 0."""
    run_seed: int | None
    trial_seed: int | None
    """Seed derived from (run seed, scenario, k)."""
    noise: str
    """`per_trial`: torch's generator was set for this trial alone; `per_batch`: for the batch it ran in, so a
    policy that draws from it depends on the batch; `unseeded`: the run had no seed."""
    batch_size: int
    """Trials that shared a policy batch, at most."""
    outcome: str
    """A `scenario.Outcome`."""
    success: bool
    reason: str
    """Why, for an invalid outcome."""
    steps: int
    """New environment steps; replayed ones do not count."""
    horizon: int
    handoff_eef_error_mm: float | None
    handoff_object_error_mm: float | None
    handoff_identical: bool | None
    handoff_from_snapshot: bool | None
    handoff_s: float | None
    sim_s: float
    policy_s: float
    """Wall time between the environment's reply and the next action, shared by the batch."""
    actions_sha256: str
    """Hash of the executed actions, float32 or float64 as the policy gave them."""
    interventions: list
    """Kind and step of every intervention; empty for direct control."""
    policy: str
    execution_horizon: int | None
    options: dict
    """What else decides a result: picture size, control mode, handoff check, and the like."""
    versions: dict
    config_hash: str
    finished_at: str
    """UTC, ISO 8601."""
    progress: list | None
    """How much of the task was done where the policy took over, and after each of its steps, in whole per
    cent; None where the platform does not tell, and in logs of schema 1. A rollback puts the number of the
    state that it went to in place of the last one."""
    first_state: str = ""
    """Hash of the task's first state (`TrialStart.first_state_sha256`): initial-state trials of scenarios
    that share it are the same trial. Empty in logs before schema 3."""
    policy_settings: dict | None = None
    """Everything about the policy beside its files that can change a result: options after the command line,
    rename map, mapping file. None, not recorded, in logs before schema 3."""
    run_scenarios: int | None = None
    """Scenarios that the run's selection has, over all its shards; None in logs before schema 3."""
    run_trials: int | None = None
    """Trials per scenario that the run asked for; None where the caller did not say."""
    shard: str = ""
    """Part of the selection that the run had, `k/n` with k from 0; empty in logs before schema 3."""

    robot: dict | None = None
    """What only a robot's trial has: start error, verdict, rater, reset time (`logs.robot.RobotTrial`).
    None for simulated trials, and in logs before schema 4."""

    def __repr__(self) -> str:
        names = ("scenario_id", "start", "trial", "policy", "outcome", "steps", "horizon")
        shown = [*names, "reason"] if self.reason else names
        return f"TrialRow({', '.join(f'{name}={getattr(self, name)!r}' for name in shown)})"

    def key(self) -> tuple:
        """What makes it the same trial: a rerun that meets the key again skips it."""
        return trial_key(self.scenario_sha256, self.scenario_id, self.config_hash, self.trial)


@dataclass(frozen=True)
class LoggedTrial:
    """A finished trial and what was executed in it. Apart from `TrialRow`: a log alone has no actions."""

    row: TrialRow
    actions: np.ndarray
    """(steps, A), of the type that the policy gave: replaying them is exact only in that type."""


def trial_key(scenario_sha256: str, scenario_id: str, config_hash: str, trial: int) -> tuple:
    """Identity of a trial within a log."""
    return (scenario_sha256, scenario_id, config_hash, trial)


def trial_seed(run_seed: int | None, scenario_id: str, trial: int) -> int | None:
    """63-bit seed of trial k of a scenario, from (run seed, scenario, k) alone."""
    if run_seed is None:
        return None
    digest = hashlib.sha256(f"{run_seed}/{scenario_id}/{trial}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def make_row(
    scenario: TrialStart,
    protocol: EvalProtocol,
    *,
    dataset: str,
    dataset_revision: str | None,
    trial: int,
    noise: str,
    batch_size: int,
    outcome: Outcome,
    reason: str,
    steps: int,
    handoff: Handoff | None,
    sim_s: float,
    policy_s: float,
    actions_sha256: str,
    interventions: Iterable = (),
    progress: Sequence[int] | None = None,
    extent: RunExtent | None = None,
    robot: Mapping[str, Any] | None = None,
) -> TrialRow:
    """The one place where a trial row is built."""
    labels = scenario.labels
    return TrialRow(
        schema=TRIAL_SCHEMA,
        scenario_id=scenario.id,
        scenario_sha256=scenario.sha256(),
        dataset=_writable(dataset),
        dataset_revision=dataset_revision,
        platform=scenario.platform,
        suite=scenario.task.suite,
        task=scenario.task.name,
        instruction=scenario.task.instruction,
        stage=labels.stage,
        deviation=labels.deviation,
        source=labels.source,
        source_policy=labels.source_policy,
        cluster=labels.cluster,
        split=labels.split,
        start=protocol.start,
        rewind_steps=protocol.rewind_for(scenario),
        handoff_step=handoff.step if handoff else 0,
        trial=trial,
        run_seed=protocol.run_seed,
        trial_seed=trial_seed(protocol.run_seed, scenario.id, trial),
        noise=noise,
        batch_size=batch_size,
        outcome=outcome.value,
        success=outcome is Outcome.SUCCESS,
        # Sanitizes the error text so that the row stays readable.
        reason=reason[:MAX_TEXT].encode(errors="replace").decode(),
        steps=steps,
        horizon=scenario.task.horizon,
        handoff_eef_error_mm=handoff.eef_error_mm if handoff else None,
        handoff_object_error_mm=handoff.object_error_mm if handoff else None,
        handoff_identical=handoff.identical if handoff else None,
        handoff_from_snapshot=handoff.from_snapshot if handoff else None,
        handoff_s=round(handoff.seconds, 4) if handoff else None,
        sim_s=round(sim_s, 4),
        policy_s=round(policy_s, 4),
        actions_sha256=actions_sha256,
        interventions=list(interventions),
        policy=_writable(protocol.policy),
        execution_horizon=protocol.execution_horizon,
        options=dict(protocol.options),
        versions=dict(protocol.versions),
        config_hash=protocol.config_hash(),
        finished_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        progress=None if progress is None else list(progress),
        first_state=scenario.first_state_sha256(),
        policy_settings=dict(protocol.policy_settings),
        run_scenarios=extent.scenarios if extent else None,
        run_trials=extent.trials if extent else None,
        shard=extent.shard if extent else "",
        robot=None if robot is None else dict(robot),
    )


def _writable(name: str) -> str:
    """A name as a log takes it: what a path or an error message holds beyond printable text is replaced."""
    return name if name.isprintable() else "".join(c if c.isprintable() else "\ufffd" for c in name)


_SETTERS = tuple((f.name, getattr(TrialRow, f.name).__set__) for f in fields(TrialRow))


def row_of(record: Mapping[str, Any]) -> TrialRow:
    """A row of checked fields; a frozen dataclass's own `__init__` takes eight times as long."""
    row = object.__new__(TrialRow)
    for name, put in _SETTERS:
        put(row, record[name])
    return row


def actions_digest(actions: Iterable[np.ndarray]) -> str:
    """What a trial row calls `actions_sha256`."""
    digest = hashlib.sha256()
    for action in actions:
        digest.update(np.ascontiguousarray(action).tobytes())
    return digest.hexdigest()


def actions_path(folder: Path, row: TrialRow) -> Path:
    """File of a trial's actions, by their own hash."""
    return folder / f"{row.actions_sha256}.npy"


def put_actions(folder: Path, actions: np.ndarray, row: TrialRow) -> None:
    """Puts a trial's actions on disk, where they are not there.

    Args:
        folder: `actions` beside the log; made if need be.
        actions: (n, A), those of the row.
        row: the trial's.
    """
    path = actions_path(folder, row)
    if row.steps and not path.exists():  # trials may have the same actions
        with atomic_file(path) as file, open(file, "wb") as stream:
            np.save(stream, actions, allow_pickle=False)


def read_actions(folder: Path, row: TrialRow) -> np.ndarray:
    """A trial's actions, checked against its row.

    Args:
        folder: `actions` beside the log.
        row: the trial's.

    Returns:
        (n, A), of the type that the policy gave: replaying them is exact only in that type. As many as the
        trial took steps, and those on top that a rollback undid.

    Raises:
        ScenarioError: they are not there, or are others.
    """
    if not row.steps:
        return np.zeros((0, 0), np.float32)
    path = actions_path(folder, row)
    try:
        # Mapped first: a header may claim any size, and is refused where the file has another.
        actions = np.array(np.lib.format.open_memmap(path, mode="r"))
    except (OSError, ValueError, EOFError) as err:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} by {row.policy}: its actions cannot be read ({err}). A "
            f"log alone cannot be replayed; keep {folder} beside it, or run the policy again with a new log "
            f"and {OPTION}"
        ) from None
    if actions.ndim != 2 or len(actions) < row.steps or actions_digest(actions) != row.actions_sha256:
        raise ScenarioError(f"{path} does not hold the actions of trial {row.trial} of {row.scenario_id}")
    return actions
