"""Runs forks through the engine: one log, one pool of simulators, an arm after the other.

Arms are different policies, loaded one at a time; the forks of an arm run at once. The log is an ordinary
trial log whose rows say in `options.fork` which fork they are of (`analysis.stats.fork_gain.ForkNote`), so a
rerun goes on where it was interrupted, and more steps, arms or repeats can be added later.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.analysis.stats.fork_gain import CONTINUE, FORK, MATCHED
from lerobot_roborecover.analysis.stats.labels import settings_differences
from lerobot_roborecover.curation.policy_trials import TRIALS_FILE, env_config
from lerobot_roborecover.detection.forks.arms import ForkArm
from lerobot_roborecover.detection.forks.parents import Choice, rows_of, usable, with_actions
from lerobot_roborecover.detection.forks.trial import ANOTHER, OWN, Fork, ForkRun, TeacherForcedRunner
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.session import EvalSession, create_session
from lerobot_roborecover.evaluation.work_items import WorkItem, unfinished
from lerobot_roborecover.logs.row import LoggedTrial, TrialRow
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.policies.runner import PolicyRunner
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.options import internal, json_object, option

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig

_FREE = ("rewind_rule", FORK)
"""Options of a row that a fork takes from it, and not from the environment."""
_CHECKED = 10
"""Of a deterministic policy's trials one in so many is continued to check that it is."""


@dataclass(frozen=True)
class ForkRequest:
    """What is asked for."""

    logs: Sequence[Path] = option(positional=True)
    """Trial logs of runs with --env.record_actions=true."""
    policy: str = option(checkpoint=True)
    """Checkpoint that ran the trials: folder or Hub id."""
    out: Path = option()
    """Folder of the forks' log and page; a rerun goes on there."""
    arms: Sequence[ForkArm] = internal(())
    """Beside `continue`, which is always there."""
    choice: Choice = field(default_factory=Choice)
    repeats: int = 1
    """Random streams for each fork, shared by its arms."""
    scenarios: str = ""
    """Scenario set of the trials (default: the one that they name)."""
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    env: Sequence[str] = option((), metavar="NAME=VALUE")
    """Option of the recovery env type that the rows do not say; may be given again."""
    policy_options: Sequence[str] = option((), name="policy-option", metavar="NAME=VALUE")
    """Option of the policy as it was run, e.g. n_action_steps=10; may be given again."""
    rename_map: Mapping[str, str] = option(
        factory=dict, name="rename_map", parse=json_object("--rename_map", "observation keys")
    )
    """The env's observation keys to the policy's, JSON, as it was run."""
    correction_steps: int = 30
    """Steps of a correction policy."""
    device: str | None = None
    """Device of the policies."""
    slots: int = option(0, name="num-workers", old=("slots",))
    """Simulators at once (as roborecover eval)."""
    max_batch: int = 1
    """Observations per inference; above 1 a policy's last bits depend on the rest of the batch."""
    deterministic: bool = False
    """The policy does the same in every trial: going on is the logged trial, which is not run again (one in
    ten is, to check)."""

    def __post_init__(self):
        if not 1 <= self.repeats <= 10_000:
            raise OptionError(f"--repeats={self.repeats}: random streams per fork, from 1 to 10000")
        if not 1 <= self.max_batch <= 4096:
            raise OptionError(f"--max-batch={self.max_batch}: must be from 1 to 4096")


@dataclass(frozen=True)
class ForkResult:
    log: Path
    rows: tuple[TrialRow, ...]
    """Rows of the forks that were asked for."""
    parents: int
    dropped: Counter
    """Why other trials of the logs were not forked."""


def run_forks(
    request: ForkRequest, on_fork: Callable[[str, int, int], None] = lambda arm, done, total: None
) -> ForkResult:
    """Runs the forks that the log does not hold yet.

    Args:
        request: what is asked for.
        on_fork: called with each finished one: its arm, and how many are done of how many.

    Raises:
        ScenarioError: the trials cannot be forked: no actions, another set, nothing left.
        OptionError: a policy or an option cannot be used.
        SimulatorError, TrialLogError: as for `roborecover eval`.
    """
    from lerobot_roborecover.evaluation.loading import policy_config

    base = policy_config(request.policy, request.policy_options, request.device)
    facts = policy_metadata(base, rename_map=request.rename_map)
    rows, dropped = usable(rows_of(request.logs, facts.policy), request.choice)
    if not rows:
        why = "; ".join(f"{n} {reason}" for reason, n in dropped.most_common())
        raise ScenarioError(f"no trial is left to be forked: {why}")
    env = _env(request, rows[0][1], sorted({row.scenario_id for _, row in rows}))
    env.trial_log, env.record_actions = str(request.out / TRIALS_FILE), True
    scenarios, run = create_session(env, env.run_spec(), workers=True, facts=facts)
    with run:
        for _, row in rows:
            _check_same(run, row)
        parents = with_actions(rows, {s.id: s for s in scenarios})
        found: list[TrialRow] = []
        for arm in (ForkArm(CONTINUE), *(a for a in request.arms if a.kind != CONTINUE)):
            found += _run_arm(request, env, run, arm, base, parents, on_fork)
    return ForkResult(request.out / TRIALS_FILE, tuple(found), len(parents), dropped)


def forks_of(
    parents: Sequence[tuple[Scenario, LoggedTrial]], arm: ForkArm, request: ForkRequest
) -> list[Fork]:
    """The forks of an arm; of each trial that continues, one more that checks, in its middle: on its own
    random stream, or of one in ten of a deterministic policy's on another."""
    found = []
    for number, (scenario, parent) in enumerate(parents):
        steps = request.choice.steps(parent)
        found += [Fork(scenario, parent, step, arm, k) for step in steps for k in range(request.repeats)]
        if arm.teacher_forced and steps and not (request.deterministic and number % _CHECKED):
            on = ANOTHER if request.deterministic else OWN
            found.append(Fork(scenario, parent, steps[len(steps) // 2], arm, on=on))
    return found


def _run_arm(
    request: ForkRequest,
    env: RecoveryEnvConfig,
    shared: EvalSession,
    arm: ForkArm,
    base: PreTrainedConfig,
    parents: Sequence[tuple[Scenario, LoggedTrial]],
    on_fork: Callable[[str, int, int], None],
) -> list[TrialRow]:
    config = arm.config(base, request.correction_steps)
    facts = policy_metadata(config, rename_map=request.rename_map)
    options = {**shared.protocol.options, **(facts.intervention.options() if facts.intervention else {})}
    protocol = replace(
        shared.protocol, policy=facts.policy, execution_horizon=facts.execution_horizon, options=options,
        policy_settings=facts.policy_settings, run_seed=parents[0][1].row.run_seed,
    )  # fmt: skip
    forks = forks_of(parents, arm, request)
    of_run: dict[str, Any] = {f.name: getattr(shared, f.name) for f in fields(EvalSession)}
    of_run |= {"protocol": protocol, "intervention": facts.intervention}
    run = ForkRun(**of_run, forks=forks)
    units = [WorkItem(fork.scenario, k) for k, fork in enumerate(forks)]
    todo = unfinished(run, units)
    if request.deterministic and arm.teacher_forced:
        rest = [forks[unit.trial] for unit in todo if forks[unit.trial].on == MATCHED]
        for fork in rest:
            run.reuse_logged_outcome(fork)
        todo = unfinished(run, units) if rest else todo
    done = [len(units) - len(todo)]
    on_fork(arm.kind, done[0], len(units))

    def told(_row: TrialRow) -> None:
        done[0] += 1
        on_fork(arm.kind, done[0], len(units))

    places = EngineConfig(slots=request.slots, device=str(config.device), draws=env.obs_type != "state")
    make_host = partial(_host, request, env, config, arm)
    run_work_items(run, todo, make_host, places, on_row=told).check_all_run()
    keys = set(run.keys([(u.scenario, u.trial) for u in units]))
    return [row for row in run.require_log().rows if row.key() in keys]


def _host(
    request: ForkRequest, env: RecoveryEnvConfig, config: PreTrainedConfig, arm: ForkArm
) -> PolicyRunner:
    from lerobot_roborecover.evaluation.loading import HostSpec, load_host

    host = load_host(HostSpec(config, env, request.rename_map, max_batch=request.max_batch))
    if not arm.teacher_forced:
        return host
    if not hasattr(host, "reseed"):
        raise OptionError(
            f"--policy={request.policy}: a {config.type} policy keeps its random stream to itself, so that "
            "what it remembers cannot be continued on another. Fork trials of the checkpoint itself"
        )
    return TeacherForcedRunner(host)


def _env(request: ForkRequest, row: TrialRow, ids: Sequence[str]) -> RecoveryEnvConfig:
    """The environment in which a trial was run, as far as its row says."""
    from lerobot_roborecover.evaluation.env_configs import env_type

    known = {f.name for f in fields(env_type(row.platform))}
    given = {option.partition("=")[0] for option in request.env}
    said = [
        f"--{name}={_word(value)}"
        for name, value in row.options.items()
        if name in known - given and name not in _FREE and isinstance(value, str | int | float | bool)
    ]
    revision = request.revision or (None if request.scenarios else row.dataset_revision)
    which = [f"--select=id={'|'.join(ids)}"] + ([f"--revision={revision}"] if revision else [])
    others = [f"--{option}" for option in request.env]
    return env_config(row.platform, request.scenarios or row.dataset, [*said, *which, *others])


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _check_same(run: EvalSession, row: TrialRow) -> None:
    """Refuses a trial that another environment, or another chunk length, gave: it would be another trial
    here."""
    if row.execution_horizon != run.protocol.execution_horizon:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} executed {row.execution_horizon} actions per inference, "
            f"the policy now {run.protocol.execution_horizon}: give --policy-option "
            f"n_action_steps={row.execution_horizon}"
        )
    if row.policy_settings is None:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} was written by an earlier version, which does not say "
            "the policy's options: what it did may not be continued. Run it again, with "
            "--env.record_actions=true"
        )
    settings = run.protocol.policy_settings
    if row.policy_settings != settings:
        differences = settings_differences(row.policy_settings, dict(settings))
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} was run with other settings of the policy than here "
            f"(there / here: {differences}), which gives another trial. Fork it with --policy-option, "
            "--rename_map and --device as it was run"
        )
    here, there = dict(run.protocol.options), {k: v for k, v in row.options.items() if k not in _FREE}
    for kind, ours, theirs in (("option", here, there), ("version of", run.protocol.versions, row.versions)):
        for name in sorted({*ours, *theirs}):
            if ours.get(name) != theirs.get(name):
                remedy = f"--env {name}={theirs.get(name)}" if kind == "option" else "that version"
                raise ScenarioError(
                    f"trial {row.trial} of {row.scenario_id} was run with {kind} {name} "
                    f"{theirs.get(name)!r}; here it is {ours.get(name)!r}, which gives another trial. "
                    f"Fork it with {remedy}"
                )
