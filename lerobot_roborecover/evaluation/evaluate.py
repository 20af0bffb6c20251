"""Evaluation as a function: for notebooks, scripts and training loops. `roborecover eval` without the files.

A policy that is handed over as an object comes back as it was: its modules' train and eval modes, the
process's random states (Python, numpy, torch) and torch's backend switches are put back. What LeRobot's own
loop would change as well, the queue of actions that a policy keeps for itself, is emptied.
"""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.configs import NormalizationMode
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy

from lerobot_roborecover.analysis.summary import summarise
from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig, env_type
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.lerobot_introspection import env_processors
from lerobot_roborecover.evaluation.loading import (
    HostSpec,
    load_host,
    load_processors,
    policy_config,
    remedy_of,
)
from lerobot_roborecover.evaluation.progress import ProgressLine, RunProgress
from lerobot_roborecover.evaluation.session import create_session
from lerobot_roborecover.evaluation.videos import VideoRecorder, default_videos
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.log_file import videos_of_run
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.policies.callables import (
    CallableRunner,
    callable_metadata,
    is_callable_policy,
    keeps_history,
)
from lerobot_roborecover.policies.identity import object_identity
from lerobot_roborecover.policies.local_runner import LocalPolicyRunner
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.policies.runner import PolicyRunner, ProvidesRunner
from lerobot_roborecover.scenario import Scenario, Start
from lerobot_roborecover.utils.temporary import TemporaryFolder
from lerobot_roborecover.utils.text import nearest, pluralize

logger = logging.getLogger(__name__)


def evaluate(
    policy: Any,
    scenarios: str | Path | ScenarioSet | Sequence[Scenario],
    *,
    env: Mapping[str, Any] | Any = None,
    trials: int = 5,
    seed: int | None = 1000,
    processors: tuple[Any, Any] | str | Path | None = None,
    rename_map: Mapping[str, str] | None = None,
    device: str | None = None,
    name: str = "",
    log: str | Path | None = None,
    videos: int | None = None,
    slots: int = 0,
    max_batch: int = 64,
    progress: bool = True,
) -> list[TrialRow]:
    """Runs a policy on scenarios; simulators in processes of their own, the policy in this one.

    Args:
        policy: a checkpoint's folder or Hub id; a policy's configuration (`PreTrainedConfig`, which is how an
            intervention or a remote policy is named); a LeRobot policy object, e.g. the one in training
            (unwrap one that accelerate or DDP has wrapped); or any callable that takes a raw observation and
            the instruction, and returns an action (A,) or a chunk (n, A). A class, or a function without
            arguments that returns a policy, gives each trial an instance. An object with `reset()` runs one
            trial at a time, and is reset at each handoff.
        scenarios: a shipped set's name, a folder, a Hub id, or what `load_scenarios` gave, or some of it.
        env: options of the recovery env type by name, as after `--env.` (`{"start": "initial"}`), or its
            configuration.
        trials: per scenario.
        seed: of the run; trial k of a scenario draws from (seed, scenario, k) alone.
        processors: pre- and postprocessor of a policy object, or the checkpoint that they are saved with.
            Default: those of the checkpoint in `policy.config.pretrained_path`; a policy whose features are
            not normalised needs none.
        rename_map: the environment's observation keys to the policy's, as `--rename_map` of `lerobot-eval`.
        device: of a policy that is loaded here; None takes what its configuration says.
        name: of the policy in the rows, whose settings then hold its identity. Required for a callable.
            Default: a checkpoint's identity, or an object's type and a hash of its weights, configuration and
            processors.
        log: trial log to write to; trials that it holds already are not run again. None keeps none.
        videos: how many to keep, in a folder `videos_...` beside the log; `report` shows them. They are of
            the first trials of scenarios spread over the set, the same for every policy. Default: 4 where
            there is a log and the environment renders images, or `env` says `videos`; else none.
        slots: simulators at once; 0 takes what `roborecover eval` would.
        max_batch: observations per inference, at most.
        progress: show a line with trials, success so far and time left.

    Returns:
        A row per trial, in the order of the scenarios; see `TrialRow` for its fields. Trials that could not
        be run, because the policy could not be reached or hung, have none, and a warning says why.

    Raises:
        OptionError: an option, or the policy, cannot be used.
        PolicyFailedError: the first trials of a new log all failed alike; no row is written.
        ScenarioError: the scenarios cannot be loaded, or are of several platforms.
        SimulatorError: no simulator can be made.
        TrialLogError: the log is damaged or in use.
    """
    if trials < 1:
        raise OptionError(f"trials={trials}: must be 1 or more")
    chosen = _scenario_set(scenarios, env)
    options = _env_config(env, chosen.platform)
    kept = _video_count(videos, options, log)
    module: torch.nn.Module | None = policy if isinstance(policy, torch.nn.Module) else None
    with TemporaryFolder("evaluate") as folder, untouched(module):
        options.trial_log = str(log or folder / "trials.jsonl")
        if is_callable_policy(policy):
            given = {"processors": processors, "rename_map": rename_map, "device": device}
            slots = _check_callable(policy, given, slots)
            facts = callable_metadata(policy, name, n_episodes=trials)
            width = options.features["action"].shape[0]
            make_host, device, remedy = partial(CallableRunner, policy, width, max_batch), "cpu", ""
        else:
            config = _policy_config(policy, device)
            spec = HostSpec(config, options, rename_map or {}, seed, max_batch)
            own = () if module is None else _processors(spec, policy, processors)
            facts = policy_metadata(
                config, policy=name, identity=object_identity(module, own) if own else "",
                rename_map=rename_map, n_episodes=trials,
            )  # fmt: skip
            make_host = partial(_host, spec, policy, *own) if own else partial(load_host, spec)
            device, remedy = str(config.device), remedy_of(spec)
        chosen, run = create_session(
            options,
            options.run_spec(with_videos=kept > 0),
            workers=True,
            facts=facts,
            scenarios=chosen,
            run_seed=seed,
        )
        with run:
            counts = RunProgress(run.protocol.start, chosen.ids, trials)
            counts.add([asdict(r) for r in run.rows()])
            line = ProgressLine(run.protocol.start, detailed=True) if progress else None

            def show(row: TrialRow) -> None:
                counts.add([asdict(row)])
                if line is not None:
                    line.show(counts)

            units = units_of(sorted(chosen, key=lambda s: s.id), trials)
            draws = options.obs_type != "state" or kept > 0
            places = EngineConfig(slots=slots, device=device, draws=draws)
            recorder = None
            if kept:
                folder = videos_of_run(run.require_log().path, run.protocol.config_hash())
                recorder = VideoRecorder(folder, kept, "sample", chosen.ids, Start(run.protocol.start))
            result = run_work_items(
                run, units, make_host, places, on_row=show, videos=recorder, remedy=remedy
            )
            if videos and recorder is not None and not recorder.kept:
                logger.warning("no video was recorded: all trials were in the log. Take another log")
            if result.unrun:
                count = pluralize(len(result.unrun), "trial")
                logger.warning("%s could not be run, and have no row: %s", count, result.problem)
            if line is not None:
                line.show(counts, final=True)
            found = {(r.scenario_id, r.trial): r for r in run.rows()}
    return [found[s.id, k] for s in chosen for k in range(trials) if (s.id, k) in found]


@contextmanager
def untouched(policy: torch.nn.Module | None = None) -> Generator[None]:
    """Puts back what an evaluation changes in a process.

    Args:
        policy: whose modes to put back.
    """
    modes = [] if policy is None else [(module, module.training) for module in policy.modules()]
    gpus = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    python, numpy = random.getstate(), np.random.get_state()
    threads = torch.get_num_threads()
    benchmark, tf32 = torch.backends.cudnn.benchmark, torch.backends.cuda.matmul.allow_tf32
    try:
        with torch.random.fork_rng(devices=gpus):
            yield
    finally:
        for module, training in modes:
            module.training = training
        random.setstate(python)
        np.random.set_state(numpy)
        torch.backends.cudnn.benchmark, torch.backends.cuda.matmul.allow_tf32 = benchmark, tf32
        torch.set_num_threads(threads)


def _scenario_set(scenarios: Any, env: Any) -> ScenarioSet:
    if isinstance(scenarios, ScenarioSet):
        return scenarios
    if isinstance(scenarios, str | Path):
        if env is None or isinstance(env, Mapping):
            said = {k: (env or {}).get(k) for k in ("revision", "split", "select")}
        else:
            said = {k: getattr(env, k) for k in ("revision", "split", "select")}
        return load_scenarios(
            str(scenarios), revision=said["revision"], split=said["split"], select=said["select"] or ""
        )
    given = tuple(scenarios)
    if not given or not all(isinstance(s, Scenario) for s in given):
        raise OptionError(
            "scenarios: give a shipped set's name, a folder, a Hub id, or scenarios of load_scenarios"
        )
    return ScenarioSet(given, "memory", None, {"platform": given[0].platform})


def _env_config(env: Mapping[str, Any] | RecoveryEnvConfig | None, platform: str) -> RecoveryEnvConfig:
    if env is not None and not isinstance(env, Mapping):
        return copy(env)
    kind = env_type(platform)
    known = [f.name for f in fields(kind)]
    for name in env or {}:
        if name not in known and name != "type":
            near = nearest(name, known)
            hint = f"the nearest is {near!r}" if near else f"there are {', '.join(known)}"
            raise OptionError(f"env: there is no option {name!r}; {hint}")
    try:
        return draccus.decode(kind, {**platform_named(platform).env_defaults, **(env or {})})
    except (draccus.utils.DraccusException, ValueError, TypeError) as err:
        raise OptionError(f"env={dict(env or {})}: {' '.join(str(err).split())}") from None


def _video_count(videos: int | None, options: RecoveryEnvConfig, log: str | Path | None) -> int:
    if videos is not None and videos < 0:
        raise OptionError(f"videos={videos}: must be 0 or more")
    if log is None and (videos or (videos is None and options.videos)):
        raise OptionError("videos: they are kept beside the trial log; name one, evaluate(..., log=FILE)")
    if log is None:
        return 0
    return default_videos(options) if videos is None else videos


def _policy_config(policy: Any, device: str | None) -> PreTrainedConfig:
    if isinstance(policy, str | Path):
        return policy_config(str(policy), (), device)
    config = policy if isinstance(policy, PreTrainedConfig) else getattr(policy, "config", None)
    if not isinstance(config, PreTrainedConfig):
        raise OptionError(
            f"policy={type(policy).__name__}: give a checkpoint's folder or Hub id, a LeRobot policy or its "
            "configuration, or a callable (observation, instruction) -> action"
        )
    if policy is config:
        config = copy(config)  # loading fills in the environment's features
        config.device = device or config.device
    return config


def _check_callable(policy: Any, given: Mapping[str, Any], slots: int) -> int:
    """Refuses arguments that a callable does not take; returns how many simulators run at once."""
    for argument, value in given.items():
        if value:
            raise OptionError(f"{argument}: only for a LeRobot policy; a callable gets raw observations")
    if not keeps_history(policy):
        return slots
    if slots > 1:
        raise OptionError(
            f"slots={slots}: an object with reset() keeps the history of one trial. Give its class, or a "
            "function that makes one (each trial gets its own), or slots=1"
        )
    return 1


def _processors(
    spec: HostSpec, module: PreTrainedPolicy, processors: tuple[Any, Any] | str | Path | None
) -> tuple[Any, Any]:
    """A policy object's pre- and postprocessor."""
    if isinstance(processors, tuple):
        return processors
    source = processors or spec.policy.pretrained_path
    modes = getattr(spec.policy, "normalization_mapping", {}).values()
    normalises = any(mode is not NormalizationMode.IDENTITY for mode in modes)
    if source is None and (normalises or spec.rename_map):
        raise OptionError(
            "processors: nothing says with which statistics this policy normalises, or where its rename map "
            "goes. Give the checkpoint that has them, evaluate(policy, ..., processors=FOLDER_OR_HUB_ID), or "
            "both processors: make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)"
        )
    return load_processors(module.config, spec, source)


def _host(spec: HostSpec, module: PreTrainedPolicy, before: Any, after: Any) -> PolicyRunner:
    module.eval()
    env_pre, env_post = env_processors(spec.env, spec.policy)
    if isinstance(module, ProvidesRunner):
        return module.make_host(env_pre, env_post, before, spec.max_batch)
    return LocalPolicyRunner(module, env_pre, env_post, before, after, spec.max_batch, in_training=True)


def metrics_of(rows: Sequence[TrialRow]) -> dict[str, float]:
    """Rows of one policy as a flat dict, for a tracker.

    Args:
        rows: of `evaluate`; starts may be mixed.

    Returns:
        By start (`recovery/`, `initial/`, `reversion/`): `success`, in which every scenario weighs the same;
        `success_low` and `success_high`, its 95 % interval, where there are scenarios enough for one;
        `trials`; `invalid`, those of them that count as failures because something broke (where all are,
        there is no rate). From recovery
        points also `macro`, in which every cell that is large enough weighs the same, `macro9` over the
        paper's nine cells, where all are there, and `cell/<cell>`.
    """
    found: dict[str, float] = {}
    for start, part in summarise([asdict(r) for r in rows]).starts.items():
        own: dict[str, float] = {"trials": part.trials, "invalid": sum(part.invalid.values())}
        if part.measured:
            own |= {"success": part.rsr.value, "success_low": part.rsr.low, "success_high": part.rsr.high}
        if start.value == "recovery" and part.measured:
            own |= {"macro": part.macro.value, "macro9": part.macro9.value}
            own |= {f"cell/{cell.cell.replace(' ', '_')}": cell.estimate.value for cell in part.cells}
        found |= {f"{start.value}/{key}": float(value) for key, value in own.items()}
    return {key: value for key, value in found.items() if not math.isnan(value)}


@dataclass
class EvaluationCallback:
    """Call it after every step of a training loop; every `every` steps it evaluates and logs.

    It goes by LeRobot's `--eval_freq`: at steps that `every` divides, and never at step 0.
    """

    scenarios: Any
    """As for `evaluate`."""
    every: int
    """Steps between evaluations."""
    log: Callable[..., Any]
    """Takes `log(metrics, step=step)`: `wandb.log`, a run's `run.log`, `trackio.log`, or a function of your
    own."""
    starts: Sequence[str] = ("recovery",)
    """Where the policy takes over; `("recovery", "initial")` says what a failure to recover is a part of."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `evaluate`: `env`, `trials`, `seed`, `slots`, ..."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise OptionError(f"every={self.every}: a number of steps, 1 or more")

    def __call__(self, step: int, policy: Any, processors: tuple[Any, Any] | None = None) -> dict[str, float]:
        """Evaluates if it is time.

        Args:
            step: training steps taken.
            policy: as it is now; comes back as it was.
            processors: its pre- and postprocessor.

        Returns:
            What was logged; empty where it was not time.
        """
        if not step or step % self.every:
            return {}
        options: dict[str, Any] = {"name": f"step {step}", "videos": 0, **self.options}
        options["processors"] = processors
        rows: list[TrialRow] = []
        for start in self.starts:
            options["env"] = {**self.options.get("env", {}), "start": start}
            rows += evaluate(policy, self.scenarios, **options)
        metrics = metrics_of(rows)
        self.log(metrics, step=step)
        return metrics
