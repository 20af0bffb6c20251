"""What all trials of a run share, and how it is opened: everything that can be refused is refused here,
before a simulator starts.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.datasets.load import validate_for
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.options import POLICY_WATCHDOG_S, RecoveryOptions
from lerobot_roborecover.evaluation.real_time import RealTime
from lerobot_roborecover.evaluation.session_checks import check_batch, check_intervention, check_versions
from lerobot_roborecover.evaluation.trial import Trial
from lerobot_roborecover.logs.row import (
    ACTIONS_FOLDER,
    EvalProtocol,
    RunExtent,
    TrialRow,
    put_actions,
    trial_key,
)
from lerobot_roborecover.logs.trial_log import RowLog, TrialLog, check_retry
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.versions import row_versions
from lerobot_roborecover.policies.interventions.options import InterventionFacts
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.scenario import Scenario, Start, TrialStart
from lerobot_roborecover.utils.temporary import TemporaryFolder
from lerobot_roborecover.utils.text import pluralize
from lerobot_roborecover.workers.messages import SlotConfig
from lerobot_roborecover.workers.slots import SlotPool

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SimulatorSpec:
    """What an env type brings to a run, beside the common options."""

    slot: SlotConfig
    """How workers make their simulator."""
    decisive: Mapping[str, Any]
    """Simulator options that decide a result, for the trial rows."""
    picture: Callable[[dict], np.ndarray] | None
    """Frame for LeRobot's videos from an observation; None asks the simulator."""
    assets: Mapping[str, str] = field(default_factory=dict)
    """Hashes of assets that decide the physics, under the names a fingerprint gives them."""


@dataclass
class EvalSession:
    """What all scenarios of a run share. As a context, it ends workers and log when the last user leaves."""

    pool: SlotPool
    protocol: EvalProtocol
    log: RowLog | None
    """None where the rows are not stored."""
    dataset: str
    dataset_revision: str | None
    handoff_check: bool = True
    extent: RunExtent | None = None
    """How much the run is to evaluate; None outside of an evaluation."""
    picture: Callable[[dict], np.ndarray] | None = None
    """Upright frame (H, W, 3) uint8 of an unbatched observation, for LeRobot's videos; None asks the
    simulator."""
    intervention: InterventionFacts | None = None
    """Intervention of a composite policy."""
    real_time: RealTime | None = None
    """None where the simulator waits for the policy."""
    policy_watchdog_s: float = POLICY_WATCHDOG_S
    """Longest time of one inference in seconds; infinite for no limit."""
    on_trial_end: Callable[[Trial, TrialRow], None] = lambda trial, row: None
    """Called when a trial ends, before its row is written."""

    def __enter__(self) -> Self:
        self.pool.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.release()

    def action_width(self, scenario: TrialStart) -> int:
        """Values in a policy's action, which need not be those of the scenario's prefix."""
        options = self.pool.config.options if self.pool is not None else {}
        return platform_named(scenario.platform).policy_action_width(options, scenario.prefix.shape[1])

    def rollback_steps(self, scenario: TrialStart) -> int:
        """Returns the most steps that a rollback may be requested for."""
        return self.intervention.rollback_steps(scenario) if self.intervention else 0

    def require_log(self) -> RowLog:
        """Returns the log; every run of `create_session` has one.

        Raises:
            RuntimeError: it has none.
        """
        if self.log is None:
            raise RuntimeError("this run keeps no trial log")
        return self.log

    def retry(self, outcomes: Sequence[str]) -> tuple[int, Path]:
        """Removes the log's trials with these outcomes, so that they run again.

        Args:
            outcomes: invalid outcomes.

        Returns:
            The number of removed trials, and the file beside the log that keeps their rows.
        """
        log = self.require_log()
        beside = log.path.with_name(f"{log.path.name}.retried.jsonl")
        if not isinstance(log, TrialLog):
            raise RuntimeError(f"the rows of {log.path} are kept with things that would not go with them")
        return log.set_aside(check_retry(outcomes), beside, self.protocol.config_hash()), beside

    def rows(self) -> list[TrialRow]:
        """The log's rows of this run's protocol."""
        config_hash = self.protocol.config_hash()
        return [] if self.log is None else [r for r in self.log.rows if r.config_hash == config_hash]

    def keys(self, trials: Sequence[tuple[TrialStart, int]]) -> list[tuple]:
        """Returns the log's keys of trials, given as scenario and k."""
        hash_ = self.protocol.config_hash()
        return [trial_key(scenario.sha256(), scenario.id, hash_, k) for scenario, k in trials]

    def trial(self, scenario: TrialStart, index: int, protocol: EvalProtocol | None = None) -> Trial:
        """Makes a trial of the run, not started yet.

        Args:
            scenario: one of the run's.
            index: k.
            protocol: in place of the run's own, for a loop that learns its seed late.
        """
        return Trial(
            scenario,
            index,
            protocol or self.protocol,
            action_width=self.action_width(scenario),
            handoff_check=self.handoff_check,
            rollback_steps=self.rollback_steps(scenario),
            real_time=self.real_time,
        )

    def record(self, trial: Trial, *, noise: str, batch_size: int) -> TrialRow:
        """The row of a trial that is over, on disk before this returns; arguments as `Trial.row`."""
        row = trial.row(
            dataset=self.dataset,
            dataset_revision=self.dataset_revision,
            noise=noise,
            batch_size=batch_size,
            extent=self.extent,
        )
        self.on_trial_end(trial, row)
        if self.log is not None:
            self.log.append(row)
        return row


def create_session(
    options: RecoveryOptions,
    spec: SimulatorSpec,
    *,
    workers: bool,
    facts: PolicyMetadata | None = None,
    scenarios: ScenarioSet | None = None,
    run_seed: int | None = None,
    announce: bool = True,
) -> tuple[ScenarioSet, EvalSession]:
    """Checks everything, loads the scenarios and opens the trial log; no simulator starts yet.

    Args:
        options: the env type's options.
        spec: what the env type adds.
        workers: simulators in processes of their own, or in this one.
        facts: who is evaluated, and how much of it.
        scenarios: what to run in place of those that the options name.
        run_seed: seed of the run; None where the caller sets one later, or has none.
        announce: log what will be run, and where its trials are recorded.

    Raises:
        OptionError: an option, or the batch size, cannot be used.
        ScenarioError: the scenarios cannot be loaded, are of another platform, or none is selected.
        TrialLogError: the trial log is damaged or in use.
    """
    options.check()
    facts = facts or PolicyMetadata()
    check_batch(facts)
    platform = spec.slot.platform
    scenarios = _load(options, platform) if scenarios is None else scenarios
    selected = len(scenarios)
    scenarios = _of_this_run(scenarios, options, platform)
    check_versions(scenarios, platform, spec.assets, options.strict_versions)
    start = Start(options.start)
    decisive = {**spec.decisive, "handoff_check": options.handoff_check}
    if start is Start.REVERSION and options.rewind_steps is None:
        decisive["rewind_rule"] = "paper"
    if facts.intervention is not None:
        check_intervention(facts.intervention, start)
        decisive |= facts.intervention.options()
    real_time = _real_time(options, facts)
    if real_time is not None:
        decisive |= real_time.decisive()
    protocol = EvalProtocol(
        start=start.value,
        rewind_steps=options.rewind_steps if start is Start.REVERSION else 0,
        policy=facts.policy,
        run_seed=run_seed,
        execution_horizon=facts.execution_horizon,
        policy_settings=facts.policy_settings,
        options=decisive,
        versions=row_versions(platform),
    )
    log = TrialLog(options.trial_log_path(facts.output_dir))
    if announce:
        trials = "" if facts.n_episodes is None else f", {pluralize(facts.n_episodes, 'trial')} each"
        logger.info(
            "RoboRecover: %s of %s%s%s from %s; trial log %s (%s already there)",
            pluralize(len(scenarios), "scenario"), scenarios.source, _all_splits(scenarios, options), trials,
            start.value, log.path, pluralize(len(log), "row"),
        )  # fmt: skip
    for remark in log.other_rows(protocol):
        logger.warning("%s", remark)
    if log.dropped_bytes:
        logger.warning("dropped a last line of %d bytes that a crash had cut off", log.dropped_bytes)
    folder, shared = options.snapshot_dir, None
    if not folder:
        shared = TemporaryFolder("snapshots")
        folder = str(shared.path)
    pool = SlotPool(replace(spec.slot, snapshot_dir=folder), workers=workers, timeout_s=options.watchdog_s)
    if shared is not None:
        pool.on_close(shared.close)
    pool.on_close(log.close)
    run = EvalSession(
        pool=pool,
        protocol=protocol,
        log=log,
        dataset=scenarios.source,
        dataset_revision=scenarios.revision,
        handoff_check=options.handoff_check,
        extent=RunExtent(selected, facts.n_episodes, "{}/{}".format(*options.shard_of())),
        picture=spec.picture,
        intervention=facts.intervention,
        real_time=real_time,
        policy_watchdog_s=options.policy_watchdog_s or float("inf"),
    )
    if options.record_actions:
        folder = log.path.with_name(ACTIONS_FOLDER)
        run.on_trial_end = lambda trial, row: put_actions(folder, trial.actions, row)
    return scenarios, run


def _real_time(options: RecoveryOptions, facts: PolicyMetadata) -> RealTime | None:
    if not options.realtime:
        return None
    if facts.intervention is not None:
        raise OptionError(
            f"--env.realtime=true with --policy.mode={facts.intervention.mode}: interventions take the "
            "frozen clock; leave one of the two out"
        )
    if facts.execution_horizon is None:
        raise OptionError(
            "--env.realtime=true charges inferences, and nothing says how many actions one gives: name "
            "--policy.n_action_steps"
        )
    return RealTime(options.during_inference, options.latency_s, facts.execution_horizon)


def _load(options: RecoveryOptions, platform: str) -> ScenarioSet:
    scenarios, split = platform_named(platform).evaluated(options.scenarios, options.split)
    return load_scenarios(scenarios, revision=options.revision, split=split, select=options.select)


def _of_this_run(scenarios: ScenarioSet, options: RecoveryOptions, platform: str) -> ScenarioSet:
    """The shard's part, without pictures."""
    validate_for(scenarios, platform)
    k, n = options.shard_of()
    part = scenarios.shard(k, n)
    if not len(part):
        raise OptionError(
            f"--env.shard={options.shard} is empty: {len(scenarios)} scenarios cannot fill {n} shards. "
            f"Use at most {len(scenarios)}"
        )
    return replace(part, scenarios=tuple(map(_without_pictures, part)))


def _all_splits(scenarios: ScenarioSet, options: RecoveryOptions) -> str:
    """Says what a run without `--env.split` mixes: " (all splits: test 64, train 131; ...)"."""
    counts = Counter(s.split for s in scenarios)
    if options.split or len(counts) < 2:
        return ""
    parts = ", ".join(f"{split} {counts[split]}" for split in sorted(counts))
    return f" (all splits: {parts}; --env.split=test takes the tests alone)"


def _without_pictures(scenario: Scenario) -> Scenario:
    """Drops the recorded frames: a run does not read them, and they would be sent to every worker."""
    mark = scenario.fingerprint
    return scenario if mark is None else replace(scenario, fingerprint=replace(mark, frames_png=()))


def group_name(row: TrialRow, by: str) -> str:
    """Name of a trial's group in `eval_info.json`."""
    if by == "cell":
        return _cell_name(row.stage, row.deviation)
    return row.source if by == "source" else row.suite


def scenario_group(scenario: Scenario, by: str) -> str:
    """Name of the group that a scenario's trials will be in."""
    if by == "cell":
        return _cell_name(scenario.stage, scenario.deviation)
    return scenario.source.value if by == "source" else scenario.task.suite


def _cell_name(stage: str, deviation: str) -> str:
    """A cell's name without spaces: LeRobot makes folders of group names."""
    return f"{stage}-{deviation}".replace(" ", "_")
