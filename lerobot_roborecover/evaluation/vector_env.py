"""What `lerobot-eval` steps: one scenario's trials as a Gymnasium vector env, on slots that outlive it.

Its life under LeRobot's rollout loop:

1. `reset`: trials are numbered on from the last batch; those that the trial log already holds, and those
   beyond the requested number, never start a simulator. The rest are handed off. torch's generator is set for
   the batch.
2. `step`: every running trial advances; one that succeeds, runs out of steps or breaks becomes a row in the
   log at once, and its slot then repeats its last observation until the batch is over.
3. LeRobot reads `is_success` from `info`; it is True only on the task's own predicate.

A handoff that is not faithful ends its trial before the policy acts. LeRobot's loop still asks the policy for
an action on the observation there, and the action is dropped. A trial without a simulator shows zeros.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import EvalSession, SimulatorSpec, create_session, scenario_group
from lerobot_roborecover.evaluation.trial import Trial, TrialState
from lerobot_roborecover.logs.row import EvalProtocol, trial_seed
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.policies.action_checks import count_problem
from lerobot_roborecover.policies.interventions.control_columns import strip_columns
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.runner import Act
from lerobot_roborecover.policies.watchdog import PolicyWatch
from lerobot_roborecover.scenario import Scenario

_FALLBACK_FRAME = (64, 64, 3)


class ScenarioVectorEnv(gym.vector.VectorEnv):
    """Trials of one scenario, `num_envs` at a time.

    Args:
        scenario: what every sub-environment rebuilds.
        num_envs: trials in a batch.
        run: slots, trial log and protocol, shared with the other scenarios.
        watch: of the policy, shared too; None where nothing watches it.
    """

    metadata = {  # noqa: RUF012 - Gymnasium's, and no ClassVar
        "render_modes": ["rgb_array"],
        "autoreset_mode": gym.vector.AutoresetMode.DISABLED,
    }

    def __init__(self, scenario: Scenario, num_envs: int, run: EvalSession, watch: PolicyWatch | None = None):
        self.scenario = scenario
        self.num_envs = num_envs
        self.run = run
        self._watch = watch
        self.render_mode = "rgb_array"
        self.metadata = {**self.metadata, "render_fps": 20}
        self._trials: list[Trial] = []
        self._frames: list[np.ndarray | None] = []
        """Picture of each trial's present state, once one was asked for."""
        self._next_trial = 0
        self._blank: dict | None = None
        self._protocol = run.protocol
        self._replied = 0.0
        self._frame_shape = _FALLBACK_FRAME
        run.pool.acquire()

    @cached_property
    def single_observation_space(self) -> gym.Space:
        """One trial's observation; asks a simulator for it on first use."""
        return self.run.pool.spaces()["observation_space"]

    @cached_property
    def observation_space(self) -> gym.Space:
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def single_action_space(self) -> gym.Space:
        return platform_named(self.scenario.platform).action_space(self.run.action_width(self.scenario))

    @cached_property
    def action_space(self) -> gym.Space:
        return batch_space(self.single_action_space, self.num_envs)

    # --- a batch of trials

    def reset(self, *, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Starts the next batch of trials.

        Args:
            seed: LeRobot's seeds, one a trial: run seed + trial index. Only the run seed is read from them.
            options: not used.
        """
        self._stop_watch()
        first = self._next_trial
        self._next_trial += self.num_envs
        self._protocol = self._with_run_seed(seed, first)
        self._trials = [
            self.run.trial(self.scenario, first + i, self._protocol) for i in range(self.num_envs)
        ]
        self._frames = [None] * self.num_envs
        self.metadata["render_fps"] = int(self.run.pool.spaces()["hz"])
        slots = self.run.pool.slots(self.num_envs)
        for trial in self._trials:
            self._skip_what_is_done(trial)
        begun = [(t, s) for t, s in zip(self._trials, slots, strict=True) if not t.over]
        for trial, slot in begun:
            slot.send("reset", trial.begin())
        for trial, slot in begun:
            trial.on_reply(slot.receive())
            self._record_if_over(trial)
        self._seed_policy_noise(first)
        self._replied = time.perf_counter()
        self._start_watch()
        return self._observation(), {"is_success": np.zeros(self.num_envs, bool)}

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Advances every running trial by one step; a trial that is to be rolled back does so instead.

        Args:
            actions: (num_envs, action width), or as many columns more as `control_columns.WIDTH`.
        """
        self._stop_watch()
        waited = time.perf_counter() - self._replied
        slots = self.run.pool.slots(self.num_envs)
        before = np.array([t.over for t in self._trials])
        decisions = strip_columns(np.asarray(actions), self.run.action_width(self.scenario))
        miscounted = count_problem(len(decisions), self.num_envs)
        working = []
        for index, trial in enumerate(self._trials):
            if trial.over:
                continue
            if miscounted:
                trial.on_policy_error(miscounted, seconds=waited)
                self._record_if_over(trial)
                continue
            move = trial.on_actions(decisions[index], seconds=waited)
            if move is None:
                self._record_if_over(trial)
                continue
            if not isinstance(move, Act):
                slots[index].send("rollback", move.steps)
            elif len(move.actions) == 1:
                slots[index].send("step", move.actions[0])
            else:  # the policy thought, and time went on
                slots[index].send("act", move.actions)
            working.append(index)
        for index in working:
            self._trials[index].on_reply(slots[index].receive())
            self._frames[index] = None
            self._record_if_over(self._trials[index])
        success = np.array([t.success for t in self._trials])
        done = np.array([t.over for t in self._trials])
        reward = np.where(before, 0.0, success.astype(np.float64))
        self._replied = time.perf_counter()
        self._start_watch()
        return self._observation(), reward, done & success, done & ~success, {"is_success": success}

    # --- LeRobot's other questions

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple:
        """One answer per sub-environment to `name`: an attribute, or `render`."""
        if name == "render":
            return tuple(self._picture(index) for index in range(self.num_envs))
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple:
        """`task`, `task_description` (the instruction) and `_max_episode_steps` (S), once per
        sub-environment."""
        task = self.scenario.task
        back = self.run.rollback_steps(self.scenario)
        # A rollback takes a turn of LeRobot's loop, and what it undoes is run on top of S.
        turns = task.horizon + (back + 1 if back else 0)
        values = {"task": task.name, "task_description": task.instruction, "_max_episode_steps": turns}
        if name not in values:
            raise AttributeError(f"ScenarioVectorEnv answers {sorted(values)} and 'render', not {name!r}")
        return (values[name],) * self.num_envs

    def render(self) -> tuple:
        """Upright frames (H, W, 3) uint8, one per sub-environment."""
        return self.call("render")

    def close_extras(self, **kwargs: Any) -> None:
        """Gives the slots back; the run's last scenario to do so ends the workers."""
        self._stop_watch()
        self.run.pool.release()

    # --- inside

    def _start_watch(self) -> None:
        if self._watch is not None and not all(t.over for t in self._trials):
            self._watch.begin(self._hung)

    def _stop_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()

    def _hung(self, reason: str) -> None:
        """Ends the trials that the policy has been asked about."""
        waited = time.perf_counter() - self._replied
        for trial in self._trials:
            if trial.state is TrialState.ASKED:
                trial.on_policy_error(reason, seconds=waited)
                self._record_if_over(trial)

    def _with_run_seed(self, seed: int | list[int] | None, first: int) -> EvalProtocol:
        if seed is None:
            return replace(self.run.protocol, run_seed=None)
        start = seed if isinstance(seed, int) else seed[0]
        return replace(self.run.protocol, run_seed=int(start) - first)

    def _skip_what_is_done(self, trial: Trial) -> None:
        """Ends a trial that needs no simulator: surplus to the request, or finished in an earlier run."""
        wanted = self.run.extent.trials if self.run.extent is not None else None
        if wanted is not None and trial.index >= wanted:
            trial.skip()
        elif self.run.log is not None and (found := self.run.log.find(trial.key)) is not None:
            trial.skip(success=found.success, steps=found.steps)

    def _seed_policy_noise(self, first: int) -> None:
        """Sets torch's global generator, which stock policies draw their noise from.

        At batch 1 a trial's noise then depends on (run seed, scenario, trial) alone, whatever ran before it.
        LeRobot resets the policy before the env, so nothing is drawn in between.
        """
        seed = trial_seed(self._protocol.run_seed, self.scenario.id, first)
        torch = sys.modules.get("torch")
        if torch is not None and seed is not None:
            torch.manual_seed(seed)

    def _record_if_over(self, trial: Trial) -> None:
        if trial.outcome is None:
            return
        alone = "per_trial" if self.num_envs == 1 else "per_batch"
        noise = "unseeded" if self._protocol.run_seed is None else alone
        self.run.record(trial, noise=noise, batch_size=self.num_envs)
        if not trial.outcome.valid:
            text = f"{self.scenario.id} trial {trial.index}: {trial.outcome.value}: {trial.reason}"
            print(text, file=sys.stderr)

    def _observation(self) -> dict:
        """The batch that LeRobot asks the policy about next; a trial that is over repeats its last one."""
        if self._blank is None:
            self._blank = _zeros(self.single_observation_space)
        shown = [t.ask() if t.state is TrialState.WAITING else t.observation for t in self._trials]
        return _stack([self._blank if o is None else o for o in shown])

    def _picture(self, index: int) -> np.ndarray:
        """A trial's frame for LeRobot's videos; black where the trial has none."""
        observation, frame = self._trials[index].observation, self._frames[index]
        if frame is None and observation is not None:
            if self.run.picture is not None:
                frame = self.run.picture(observation)
            else:
                slot = self.run.pool.slots(self.num_envs)[index]
                slot.send("render")
                reply = slot.receive()
                frame = reply if isinstance(reply, np.ndarray) else None
            self._frames[index] = frame
        if frame is not None:
            self._frame_shape = frame.shape
            return frame
        return np.zeros(self._frame_shape, np.uint8)


def _zeros(space: gym.Space) -> Any:
    if isinstance(space, gym.spaces.Dict):
        return {key: _zeros(sub) for key, sub in space.spaces.items()}
    return np.zeros(space.shape or (), space.dtype)


def _stack(observations: list[Any]) -> Any:
    """Stacks nested dicts of arrays along a new first axis."""
    if isinstance(observations[0], dict):
        return {key: _stack([o[key] for o in observations]) for key in observations[0]}
    return np.stack(observations)


def create_recovery_envs(
    options: RecoveryOptions,
    spec: SimulatorSpec,
    *,
    n_envs: int,
    workers: bool,
    facts: PolicyMetadata | None = None,
) -> dict[str, dict[str, ScenarioVectorEnv]]:
    """Builds what `lerobot-eval` iterates over: `{group: {scenario id: vector env}}`, tasks kept together.

    Args:
        options: the env type's options.
        spec: what the env type adds.
        n_envs: trials in a batch.
        workers: simulators in processes of their own, or in this one.
        facts: who is evaluated, and how much of it.

    Raises:
        OptionError, ScenarioError, TrialLogError: see `create_session`.
    """
    if options.realtime and options.during_inference == "chunk":
        raise OptionError(
            "--env.during_inference=chunk: LeRobot's loop hands actions over one by one, so that none is at "
            "hand during an inference. Use roborecover eval, or --env.during_inference=hold"
        )
    scenarios, run = create_session(options, spec, workers=workers, facts=facts)
    watch = None
    if facts is not None and facts.n_episodes is not None and run.policy_watchdog_s < float("inf"):
        # LeRobot's own evaluation; in anyone else's loop, a long pause may be meant.
        watch = PolicyWatch(run.policy_watchdog_s, str(run.require_log().path))
        run.pool.on_close(watch.close)
    envs: dict[str, dict[str, ScenarioVectorEnv]] = {}
    for scenario in sorted(scenarios, key=lambda s: (s.task.suite, s.task.name, s.id)):
        envs.setdefault(scenario_group(scenario, options.group_by), {})[scenario.id] = ScenarioVectorEnv(
            scenario, n_envs, run, watch
        )
    return envs
