"""RoboRecover's scenarios as a benchmark of vla-eval 0.8 (`roborecover_vla_eval:RecoveryBenchmark`).

An episode, as vla-eval's runner calls it:

1. `get_tasks`: a task per scenario; `episode_idx` is the trial.
2. `reset`: the scenario's prefix is replayed and compared. A handoff that is not faithful raises, which
   vla-eval counts among its errors; the model is not asked.
3. `make_obs`: the observation in the server's words, by the mapping that `--policy.protocol=vla_eval` uses.
4. `step`: one action; the trial is over at the task's own predicate, or at the task's horizon.

Trials are `lerobot_roborecover`'s own, and become rows of a trial log that `roborecover report` reads.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar

import draccus
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.utils.constants import ACTION
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import configure_mujoco_render
from vla_eval.specs import DimSpec

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.evaluation.env_configs import env_type
from lerobot_roborecover.evaluation.session import create_session
from lerobot_roborecover.evaluation.trial import Trial
from lerobot_roborecover.logs.fields import UNKNOWN_WEIGHTS, digest_of
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.remote.errors import RemoteError
from lerobot_roborecover.policies.remote.mapping import load_mapping
from lerobot_roborecover.policies.remote.modeling_remote import split
from lerobot_roborecover.policies.remote.translate import Translator
from lerobot_roborecover.policies.runner import Act

logger = logging.getLogger(__name__)


class EpisodeProblem(RoboRecoverError, RuntimeError):
    """An episode that says nothing of the policy, or ended because of what the policy sent."""


class RecoveryBenchmark(StepBenchmark):
    """A set of recovery scenarios.

    Args:
        platform: `libero`, `metaworld`, `robotwin`, or another installed one.
        mapping: of `lerobot_roborecover/policies/remote/mappings`, or a YAML file's path; with
            `protocol: vla_eval`.
        policy: the policy's name in trial rows.
        trial_log: file of trial rows; `{pid}` becomes the process's number. Default: a new one in
            `outputs/`.
        env: options of the recovery env type by name, as after `--env.`: `scenarios`, `select`, `start`, ...
        workers: whether the simulator has a process of its own, which a watchdog guards.
        send_wrist_image, send_state, quat_no_antipodal: of the model server's `observation_params`; vla-eval
            fills them in.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    def __init__(
        self,
        platform: str = "libero",
        mapping: str = "vla_eval_libero",
        policy: str = "unknown",
        trial_log: str = "",
        env: Mapping[str, Any] | None = None,
        workers: bool = False,
        send_wrist_image: bool = False,
        send_state: bool = False,
        quat_no_antipodal: bool = False,
    ):
        super().__init__()
        self._mapping = load_mapping(mapping)
        if self._mapping.protocol != "vla_eval" or self._mapping.actions.execute not in (None, 1):
            raise RoboRecoverError(
                f"mapping={mapping}: is for {self._mapping.protocol}; vla-eval's harness takes one of "
                "vla_eval, which executes one action an observation"
            )
        options = draccus.decode(env_type(platform), dict(env or {}))
        if options.realtime:
            raise RoboRecoverError(
                "env realtime=true: the harness waits for the model; use roborecover eval with "
                "--policy.protocol=vla_eval"
            )
        if trial_log:
            options.trial_log = trial_log.format(pid=os.getpid())
        settings = {
            "mapping": digest_of(asdict(self._mapping)),
            "flags": [send_wrist_image, send_state, quat_no_antipodal],
            UNKNOWN_WEIGHTS: "not known",
        }
        facts = PolicyMetadata(policy, "vla_eval", execution_horizon=1, policy_settings=settings)
        scenarios, self._run = create_session(options, options.run_spec(), workers=workers, facts=facts)
        self._scenarios = {s.id: s for s in scenarios}
        self._env_pre, self._env_post = options.get_env_processors()
        self._run.pool.acquire()
        self._trial: Trial | None = None
        self._asked = 0.0
        flags = {
            "send_wrist_image": send_wrist_image,
            "send_state": send_state,
            "quat_no_antipodal": quat_no_antipodal,
        }
        self._flags = frozenset(name for name, value in flags.items() if value)
        width = self._run.action_width(next(iter(self._scenarios.values())))
        self._translator = Translator(self._mapping, width=width)
        self._translator.flags = self._flags

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """MuJoCo's renderer, as vla-eval chooses it."""
        return configure_mujoco_render(mode)

    # --- what there is

    def get_tasks(self) -> list[dict[str, Any]]:
        """A task per scenario, with what the paper divides results by."""
        return [
            {
                "name": s.id,
                "suite": s.task.suite,
                "task": s.task.name,
                "instruction": s.task.instruction,
                "stage": s.stage,
                "deviation": s.deviation,
                "source": str(s.source),
            }
            for s in sorted(self._scenarios.values(), key=lambda s: s.id)
        ]

    def get_metadata(self) -> dict[str, Any]:
        """The longest horizon: each trial ends at its own."""
        return {"max_steps": max(s.task.horizon for s in self._scenarios.values())}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """What the mapping takes."""
        return {name: DimSpec(name, 0, form) for name, form in self._mapping.specs.action.items()}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """What the mapping gives."""
        return {name: DimSpec(name, 0, form) for name, form in self._mapping.specs.observation.items()}

    # --- an episode

    def reset(self, task: Mapping[str, Any]) -> dict[str, Any]:
        """Hands off.

        Raises:
            EpisodeProblem: the handoff is not faithful, or the simulator broke.
        """
        trial = self._run.trial(self._scenarios[task["name"]], int(task.get("episode_idx", 0)))
        self._trial = trial
        slot = self._slot()
        slot.send("reset", trial.begin())
        trial.on_reply(slot.receive())
        return self._after(trial)

    def step(self, action: Mapping[str, Any]) -> StepResult:
        """Executes one action.

        Raises:
            EpisodeProblem: the action cannot be executed, or the simulator broke.
        """
        trial = self._now()
        seconds = time.perf_counter() - self._asked
        trial.ask()
        try:
            found = action.get("actions", action.get("action"))
            rows = self._translator.actions({self._mapping.actions.key: np.atleast_2d(np.asarray(found))[:1]})
            rows = self._env_post({ACTION: torch.from_numpy(rows)})[ACTION].cpu().numpy()
        except RemoteError as err:
            trial.on_policy_error(err, seconds=seconds)
        else:
            move = trial.on_actions(rows, seconds=seconds)
            if isinstance(move, Act):
                slot = self._slot()
                slot.send("step", move.actions[0])
                trial.on_reply(slot.receive())
        observation = self._after(trial)
        return StepResult(observation, float(trial.success), trial.over, {"outcome": str(trial.outcome)})

    def make_obs(self, raw_obs: Mapping[str, Any], task: Mapping[str, Any]) -> dict[str, Any]:
        """The observation as the mapping says; through LeRobot's processors, as policies see it here."""
        batch = {**preprocess_observation(_batched(raw_obs)), "task": [task["instruction"]]}
        frames, tasks = split(self._env_pre(batch))
        request = self._translator.request([self._translator.frame(frames[0])], tasks[0])
        self._asked = time.perf_counter()
        return request

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Success, by the task's own predicate.

        Raises:
            EpisodeProblem: `max_steps` of the configuration ended the episode before its horizon.
        """
        trial = self._now()
        if not trial.over:
            raise EpisodeProblem(
                f"max_steps ended {trial.scenario.id} after {trial.steps} of {trial.scenario.task.horizon} "
                "steps: leave max_steps out of the configuration"
            )
        return {"success": trial.success, "outcome": str(trial.outcome)}

    def render(self) -> np.ndarray | None:
        """(H, W, 3) uint8 of the present state."""
        slot = self._slot()
        slot.send("render")
        frame = slot.receive()
        return frame if isinstance(frame, np.ndarray) else None

    def cleanup(self) -> None:
        """Closes the simulator and the trial log."""
        self._run.pool.release()

    # --- inside

    def _slot(self) -> Any:
        return self._run.pool.slots(1)[0]

    def _now(self) -> Trial:
        if self._trial is None:
            raise EpisodeProblem("no episode has begun")
        return self._trial

    def _after(self, trial: Trial) -> dict[str, Any]:
        """The observation; a trial that is over becomes a row first."""
        if trial.outcome is not None:
            if self._run.require_log().find(trial.key) is None:
                self._run.record(trial, noise="unseeded", batch_size=1)
            else:
                logger.warning("%s trial %d is in the trial log already", trial.scenario.id, trial.index)
            if not trial.outcome.valid:
                raise EpisodeProblem(f"{trial.outcome.value}: {trial.reason}")
        assert trial.observation is not None
        return trial.observation


def _batched(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: _batched(value) for key, value in observation.items()}
    return np.asarray(observation)[None]
