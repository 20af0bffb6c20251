"""`roborecover check policy`: what can go wrong with a policy, found before an hour is spent on it.

The checkpoint is loaded as an evaluation loads it, its description is read, one scenario is handed off in the
real simulator, and the policy takes a few steps there. What a mistake leaves in names, shapes, statistics and
pictures is looked for; what only a score can tell is not.
"""

import json
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.utils.utils import init_logging

from lerobot_roborecover.datasets import ScenarioSet
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation import check_names as names
from lerobot_roborecover.evaluation import check_numbers as numbers
from lerobot_roborecover.evaluation.check_names import input_remedy
from lerobot_roborecover.evaluation.check_steps import FirstSteps, hand_off_scenario, take_steps
from lerobot_roborecover.evaluation.loading import load_host
from lerobot_roborecover.evaluation.options import JSON, long_names
from lerobot_roborecover.evaluation.runner import RecoveryEvalConfig, host_spec
from lerobot_roborecover.evaluation.session import EvalSession, create_session
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.findings import (
    Check,
    Status,
    failure,
    format_report,
    ok,
    report_json,
    warning,
)
from lerobot_roborecover.policies.command_line import run_with_arguments
from lerobot_roborecover.policies.load_problems import error_words, load_remedy
from lerobot_roborecover.policies.local_runner import LocalPolicyRunner
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.policies.runner import Act, PolicyError, PolicyRunner, WatchedHost, decision_of
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.temporary import TemporaryFolder
from lerobot_roborecover.utils.text import pluralize
from lerobot_roborecover.workers.capacity import available_gb, default_slots, usable_cores
from lerobot_roborecover.workers.messages import EpisodeStart

_RECORDED = 50
"""Scenarios whose prefixes are compared with the checkpoint's statistics, at most."""


@dataclass
class CheckOptions:
    """Options of `--check.*`."""

    steps: int = 5
    """Steps the policy takes in the simulator."""
    json: bool = False
    """Print one JSON object in place of the table."""


@dataclass
class CheckPolicyConfig(RecoveryEvalConfig):
    """`roborecover eval`'s configuration, plus the check's options."""

    check: CheckOptions = field(default_factory=CheckOptions)


def check(cfg: CheckPolicyConfig) -> int:
    """Runs the checks that a command line asks for; see `main`."""
    cfg.runner.check()
    _ = cfg.recovery_env, cfg.given_policy  # refused before anything is loaded
    if not 1 <= cfg.check.steps <= 1000:
        raise OptionError(f"--check.steps={cfg.check.steps}: must be from 1 to 1000")
    with redirect_stdout(sys.stderr):  # LeRobot's loaders print
        findings = examine(cfg)
    print(json.dumps(report_json(findings), indent=2) if cfg.check.json else format_report(findings))
    return int(not report_json(findings)["ok"])


def examine(cfg: CheckPolicyConfig) -> list[Check]:
    """All checks; those that need what an earlier one did not get are left out.

    Args:
        cfg: what an evaluation would run with.

    Raises:
        OptionError, ScenarioError, TrialLogError: see `session.create_session`.
    """
    config = cfg.given_policy
    wanted = config.input_features or {}
    path = config.pretrained_path
    saved = PreTrainedConfig.from_pretrained(path) if path else None
    scenarios, run = _open(cfg)
    width = cfg.env.features["action"].shape[0]
    findings = [names.check_camera_names(_cameras(cfg))]
    if saved is not None:
        findings.append(names.check_action_width(saved, width))
    run.pool.acquire()
    try:
        try:
            host = load_host(host_spec(cfg))
        except Exception as err:  # a checkpoint may fail to load in any way
            remedy = input_remedy(cfg.recovery_env, wanted, cfg.rename_map)
            return [_not_loaded(err, remedy), *findings]
        watched = WatchedHost(host, run.policy_watchdog_s)
        run.pool.on_close(watched.close)
        findings.insert(0, ok("loads", f"{config.type} on {config.device}"))
        own = (
            host if isinstance(host, LocalPolicyRunner) else None
        )  # a composite or remote policy has no such parts
        if own is not None:
            policy, pre, post = own.parts
            if path and not config.use_peft:
                findings.append(names.check_weights(policy, str(path)))
            findings.append(names.check_statistics(pre, post, wanted, width))
        horizons = [s.task.horizon for s in scenarios]
        findings.append(names.check_horizon(config, run.pool.config.platform, min(horizons)))
        scenario = min(scenarios, key=lambda s: len(s.prefix))
        start = hand_off_scenario(run, scenario)
        if isinstance(start, Check):
            return [*findings, start]
        if own is not None:
            looks = _look(cfg, own, run, scenarios, scenario, start)
            findings += looks
            if any(c.name in ("observation", "inputs") and c.status is Status.FAILURE for c in looks):
                return findings  # the policy would only raise
        steps = take_steps(watched, run, scenario, start, seed=cfg.seed, steps=cfg.check.steps)
        if isinstance(steps, Check):
            return [*findings, steps]
        findings.append(numbers.check_executed(steps.actions, run.pool.config.platform))
        if own is not None:
            findings.append(_check_states(own, scenario, steps, run.pool.config.platform))
        findings.append(_check_trials(cfg, watched, scenario, steps.observations[0]))
        findings += _estimate(cfg, watched, scenarios, scenario, steps)
        return findings
    finally:
        run.pool.release()


def _open(cfg: CheckPolicyConfig) -> tuple[ScenarioSet, EvalSession]:
    """Loads the scenarios and opens a run whose trial log is in a temporary folder."""
    folder = TemporaryFolder("check")
    log = f"{folder.path}/trials.jsonl"
    facts = policy_metadata(cfg.policy, rename_map=cfg.rename_map, n_episodes=cfg.eval.n_episodes)
    options = copy(cfg.recovery_env)
    options.trial_log = log
    scenarios, run = create_session(options, options.run_spec(), workers=True, facts=facts, announce=False)
    run.pool.on_close(folder.close)
    return scenarios, run


def _cameras(cfg: CheckPolicyConfig) -> dict[str, str]:
    """The policy's key of each camera."""
    found = {}
    for key, feature in cfg.env.features.items():
        if feature.type is FeatureType.VISUAL:
            ours = cfg.env.features_map[key]
            found[key.removeprefix("pixels/")] = cfg.rename_map.get(ours, ours)
    return found


def _not_loaded(err: Exception, inputs: str) -> Check:
    text = f"{type(err).__name__}: {error_words(err)}"
    remedy = load_remedy(err, inputs) or "see the message; 'roborecover doctor' checks what is installed"
    return failure("loads", text, "a policy with its processors", remedy)


def _look(
    cfg: CheckPolicyConfig,
    host: LocalPolicyRunner,
    run: EvalSession,
    scenarios: ScenarioSet,
    scenario: Scenario,
    start: EpisodeStart,
) -> list[Check]:
    """Inputs, pictures and recorded actions, before the policy is asked for anything."""
    _, pre, post = host.parts
    config = cfg.given_policy
    wanted = config.input_features or {}
    platform = platform_named(run.pool.config.platform)
    try:
        batch = host.env_batch([start.observation], [scenario.task.instruction])
    except Exception as err:  # a processor may raise anything
        return [
            failure(
                "observation", f"{type(err).__name__}: {err}".splitlines()[0], "LeRobot's observation",
                "the env's processors cannot read what this env type observes: check --env.obs_type, and for "
                "X-VLA that the env type is the checkpoint's",
            )
        ]  # fmt: skip
    tensors = {cfg.rename_map.get(k, k): v for k, v in batch.items() if hasattr(v, "shape")}
    shapes = {k: tuple(v.shape[1:]) for k, v in tensors.items()}
    found = [
        names.check_features(
            wanted, shapes, config.type, input_remedy(cfg.recovery_env, wanted, cfg.rename_map, shapes)
        ),
    ]
    in_stats, _ = names.statistics_of(pre)
    out_stats, _ = names.statistics_of(post)
    pictures = {k: v[0].float().cpu().numpy() for k, v in tensors.items() if v.ndim == 4 and k in wanted}
    by_colour = numbers.check_cameras_by_colour({k: p.mean((1, 2)) for k, p in pictures.items()}, in_stats)
    found += [by_colour] if by_colour else []
    if platform.images_rotated_180 and pictures and config.type != "xvla":  # it turns the scene camera alone
        raw = next(iter(start.observation["pixels"].values()))
        key = next(iter(_cameras(cfg).values()))
        if key in pictures:
            found.append(numbers.check_upright(pictures[key], platform.upright(raw), key))
    chosen = [
        s for s in list(scenarios)[:_RECORDED] if s.prefix.shape[1] == cfg.env.features["action"].shape[0]
    ]
    same_kind = platform.records_control_mode in (None, getattr(cfg.env, "control_mode", None))
    if chosen and same_kind:
        recorded = np.concatenate([s.prefix for s in chosen])
        found.append(numbers.check_recorded_actions(recorded, out_stats.get("action")))
        turned = any("toggle" in type(s).__name__.lower() for s in post.steps)
        columns = platform.grippers(recorded.shape[1])
        if columns:
            found.append(numbers.check_gripper(recorded, out_stats.get("action"), columns, turned))
    return found


def _check_states(host: LocalPolicyRunner, scenario: Scenario, steps: FirstSteps, platform: str) -> Check:
    batch = host.env_batch(steps.observations, [scenario.task.instruction] * len(steps.observations))
    key = "observation.state"
    if key not in batch:
        return ok("states fit the training data", "not checked: the policy gets no robot state")
    stats, _ = names.statistics_of(host.parts[1])
    return numbers.check_states(batch[key].float().cpu().numpy(), stats.get(key), platform)


def _check_trials(cfg: CheckPolicyConfig, host: PolicyRunner, scenario: Scenario, observation: dict) -> Check:
    """Whether several trials of a scenario are several trials."""
    answers = []
    for trial in range(2):
        history = host.start((cfg.seed or 0) + trial)
        (answer,) = host.act([observation], [scenario.task.instruction], [history])
        host.finish(history)
        answers.append(answer if isinstance(answer, PolicyError) else decision_of(answer))
    first, second = answers
    if cfg.eval.n_episodes == 1 or isinstance(first, PolicyError):
        return ok("trials", str(cfg.eval.n_episodes))
    if isinstance(first, Act) and isinstance(second, Act) and np.array_equal(first.actions, second.actions):
        fixed = getattr(cfg.policy, "inference_seed", None)
        remedy = (
            "--policy.inference_seed=null draws anew in every trial"
            if fixed is not None
            else "a deterministic policy: --eval.n_episodes=1 says as much"
        )
        return warning(
            "trials", f"{cfg.eval.n_episodes} a scenario, and the policy does the same in each",
            "noise of its own in each trial", remedy,
        )  # fmt: skip
    return ok("trials", f"{cfg.eval.n_episodes} a scenario, noise {host.noise(cfg.seed)}")


def _estimate(
    cfg: CheckPolicyConfig, host: PolicyRunner, scenarios: ScenarioSet, scenario: Scenario, steps: FirstSteps
) -> list[Check]:
    """Inference time, alone and in a batch, and how long the whole evaluation would take at most."""
    room = default_slots(str(cfg.given_policy.device), usable_cores(), available_gb())
    slots = min(cfg.runner.slots or room, len(scenarios) * cfg.eval.n_episodes)
    batch = min(slots, host.max_batch) if host.batched else 1
    alone = statistics.median(steps.infer_s[1:] or steps.infer_s)
    together = alone
    if batch > 1:
        histories = [host.start(k) for k in range(batch)]
        for _ in range(2):  # the second one, in case the first compiles for this batch
            began = time.perf_counter()
            host.act([steps.observations[0]] * batch, [scenario.task.instruction] * batch, histories)
            together = time.perf_counter() - began
        for history in histories:
            host.finish(history)
    trials = len(scenarios) * cfg.eval.n_episodes
    budget = sum(s.task.horizon for s in scenarios) * cfg.eval.n_episodes
    horizon = getattr(host, "horizon", 1)
    policy_s = budget / horizon * together / batch
    sim_s = (budget * steps.step_s + trials * steps.reset_s) / slots
    value = (
        f"{_time(alone)} alone, {_time(together)} for a batch of {batch}; {horizon} actions each"
        if host.batched
        else f"{_time(alone)}, one slot at a time, {horizon} action each"
    )
    total = max(policy_s, sim_s)
    busy = "the policy" if policy_s > sim_s else "the simulators"
    return [
        ok("inference time", value),
        ok(
            "run time",
            f"at most {_time(total)} beside LeRobot's own start and videos, on {slots} slots for "
            f"{len(scenarios)} scenarios x {pluralize(cfg.eval.n_episodes, 'trial')} from one start "
            f"({_time(policy_s)} of the policy, {_time(sim_s)} of the simulators; {busy} is the slower), "
            f"if every trial ran to its last step. From {len(steps.actions)} steps on this machine",
        ),
    ]


def _time(seconds: float) -> str:
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def main(argv: Sequence[str]) -> int:
    """Runs with a command line in `lerobot-eval`'s words, and `--json`.

    Args:
        argv: arguments without the program's and the command's name.
    """
    from lerobot_roborecover.policies.command_line import rewrite_env_argument

    init_logging()
    program, *words = rewrite_env_argument(["roborecover-eval", *long_names(argv, JSON)])
    return run_with_arguments(check, program, words)
