"""Runs a LeRobot checkpoint on scenarios and keeps every trial's actions, exactly as executed.

The trial log names each trial's actions by their hash only. Here they are kept beside it, so that a trial can
be replayed: for the monitor's frames, or as a demonstration. A rerun goes on where it was interrupted.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.evaluation.early_checks import check_env_options
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.session import create_session
from lerobot_roborecover.evaluation.trial import Trial
from lerobot_roborecover.evaluation.work_items import unfinished, units_of
from lerobot_roborecover.logs.fields import digest_of
from lerobot_roborecover.logs.log_file import TRIALS_FILE
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, LoggedTrial, TrialRow, put_actions, read_actions
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.workers.backend import LOCAL, Backend

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig

CURRENT_FILE = "current.json"
"""Which of the log's rows are those of the last run: the others are of other files, options or seeds."""


def run_trials(
    policy: str,
    env: RecoveryEnvConfig,
    folder: Path,
    *,
    trials: int = 1,
    only: Collection[str] | None = None,
    seed: int = 1000,
    device: str | None = None,
    slots: int = 0,
    max_batch: int = 1,
    workplace: Backend = LOCAL,
    replicas: int = 0,
    policy_options: Sequence[str] = (),
    rename_map: Mapping[str, str] | None = None,
    on_row: Callable[[TrialRow, int, int], None] = lambda row, done, total: None,
) -> list[LoggedTrial]:
    """Runs what the folder does not hold yet, and returns everything.

    Args:
        policy: folder or Hub id of the checkpoint.
        env: a recovery env config (`env_config`), which names the scenarios and the observations.
        folder: of this policy alone: trial log and actions.
        trials: per scenario.
        only: ids of scenarios; None takes all.
        seed: of the run.
        device: of the policy; None takes what its config says.
        slots: simulators at work at once; 0 takes as many as there is room for.
        max_batch: observations per inference, at most. Above 1 the last bits of an action depend on the
            other observations of its inference, and so may the outcome.
        workplace: where simulators and policy are.
        replicas: copies of the policy on a cluster, see `EngineConfig`.
        policy_options: `--name=value` options of the policy's config.
        rename_map: the env's observation keys to the policy's, as `--rename_map` of `lerobot-eval`.
        on_row: called with each finished trial, and how many are done of how many.

    Returns:
        Trials by scenario id, then trial index; of exactly this policy, seed and options.

    Raises:
        OptionError, ScenarioError, SimulatorError, TrialLogError: what `roborecover eval` refuses.
        ScenarioError: the policy went away or hung, so that trials were not run.
    """
    from lerobot_roborecover.evaluation import loading

    config = loading.policy_config(policy, policy_options, device)
    facts = policy_metadata(config, rename_map=rename_map, n_episodes=trials)
    env.trial_log = str(folder / TRIALS_FILE)
    scenarios, run = create_session(env, env.run_spec(), workers=True, facts=facts, run_seed=seed)
    run.on_trial_end = partial(_keep_actions, folder / ACTIONS_FOLDER)
    spec = loading.HostSpec(config, env, rename_map or {}, seed, max_batch)
    places = EngineConfig(
        workplace, slots, replicas, str(config.device), env.obs_type != "state",
        snapshot_dir=env.snapshot_dir or None,
    )  # fmt: skip
    with run:
        chosen = [s for s in scenarios if only is None or s.id in only]
        units = units_of(sorted(chosen, key=lambda s: s.id), trials)
        keys = run.keys([(u.scenario, u.trial) for u in units])
        current = {"config_hash": run.protocol.config_hash()}
        atomic_write(folder / CURRENT_FILE, json.dumps(current) + "\n")
        done = itertools.count(len(units) - len(unfinished(run, units)) + 1)
        run_work_items(
            run, units, partial(loading.load_host, spec), places,
            on_row=lambda row: on_row(row, next(done), len(units)),
        ).check_all_run()  # fmt: skip
        rows = {r.key(): r for r in run.require_log().rows}
    return [
        LoggedTrial(rows[key], read_actions(folder / ACTIONS_FOLDER, rows[key]))
        for key in keys
        if key in rows
    ]


def went_alike(one: TrialRow, other: TrialRow) -> bool:
    """Whether two trials had the same actions and the same outcome."""
    return (one.outcome, one.actions_sha256) == (other.outcome, other.actions_sha256)


def check_repeats(name: str, rows: Sequence[TrialRow]) -> None:
    """Checks that a policy which is said to be deterministic did the same in every trial of a scenario.

    Raises:
        ScenarioError: two trials differ.
    """
    for row in rows[1:]:
        if not went_alike(row, rows[0]):
            raise ScenarioError(
                f"{name} is said to be deterministic, but trials {rows[0].trial} and {row.trial} of "
                f"{row.scenario_id} differ ({rows[0].outcome} after {rows[0].steps} steps, {row.outcome} "
                f"after {row.steps}); leave out --deterministic {name}"
            )


def read_trials(folder: Path) -> list[LoggedTrial]:
    """Trials that `run_trials` left in a folder: those of its last run's policy, options and seed.

    Raises:
        TrialLogError, ScenarioError: the log or the actions are damaged, or the folder does not say which of
            several policies or settings it is about.
    """
    rows = read_trial_log(folder / TRIALS_FILE)
    current = folder / CURRENT_FILE
    if current.is_file():
        try:
            hash_ = json.loads(current.read_bytes())["config_hash"]
        except (OSError, ValueError, TypeError, KeyError) as err:
            raise ScenarioError(f"{current} cannot be read ({err!r}); remove it, or {folder}") from None
        rows = [row for row in rows if row.config_hash == hash_]
    kinds = {digest_of([row.policy, row.policy_settings]) for row in rows if row.policy_settings is not None}
    if len(kinds) > 1:
        raise ScenarioError(
            f"{folder} holds trials of {len(kinds)} policies, or of one under several settings, which would "
            f"be mixed. Keep one in it, or name folders that hold one each"
        )
    return [LoggedTrial(row, read_actions(folder / ACTIONS_FOLDER, row)) for row in rows]


def env_config(platform: str, scenarios: str, options: Sequence[str] = ()) -> RecoveryEnvConfig:
    """A recovery env config.

    Args:
        platform: of the scenarios.
        scenarios: shipped name, folder or Hub id.
        options: `--name=value`, as after `--env.`.
    """
    check_env_options(platform, options)
    import draccus

    from lerobot_roborecover.evaluation.env_configs import env_type

    which = [f"--{name}={value}" for name, value in flat_options(platform_named(platform).env_defaults)]
    return draccus.parse(env_type(platform), args=[*which, f"--scenarios={scenarios}", *options])


def flat_options(nested: Mapping[str, Any], head: str = "") -> list[tuple[str, Any]]:
    """Options of a configuration file as those of a command line, `a.b` for `b` within `a`.

    Args:
        nested: mappings of mappings.
        head: of their names.
    """
    found = []
    for name, value in nested.items():
        if isinstance(value, Mapping):
            found += flat_options(value, f"{head}{name}.")
        else:
            found.append((f"{head}{name}", value))
    return found


def _keep_actions(folder: Path, trial: Trial, row: TrialRow) -> None:
    if not row.steps:
        return
    actions = trial.actions
    if len(actions) != row.steps:
        raise ScenarioError(
            f"trial {row.trial} of {row.scenario_id} by {row.policy} took {len(actions)} actions for "
            f"{row.steps} steps: it went back in time, and cannot be replayed as one run. Run its base "
            "policy"
        )
    put_actions(folder, trial.actions, row)
