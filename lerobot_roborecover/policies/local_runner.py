"""Batched inference with any LeRobot policy: observations in, one action chunk per trial out.

A policy whose `predict_action_chunk` depends on its argument alone infers for all waiting slots in one batch,
and each slot executes its own chunk. Any other policy (observation queues, temporal ensembling, a KV cache)
gets one instance per slot, which shares the weights, and infers slot by slot. Either way every slot has its
own history.

Every trial has its own random stream that starts from its seed, exactly as stock `lerobot-eval` seeds torch
at batch size 1. Where a policy takes its noise as an argument, or infers slot by slot, a trial draws the same
noise in any batch. Where a batched policy draws noise inside, the batch is seeded and the row says so.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyAction, PolicyProcessorPipeline
from lerobot.utils.constants import ACTION

from lerobot_roborecover.policies.action_checks import tensor_problem
from lerobot_roborecover.policies.runner import Chunk, PolicyError, Processor

logger = logging.getLogger(__name__)

STATELESS: Mapping[str, str] = {
    "act": "none",
    "pi0": "argument",
    "pi05": "argument",
    "smolvla": "argument",
    "xvla": "inside",
    "fastwam": "fixed",
}
"""Policy types whose `predict_action_chunk` depends on its batch alone after `reset()`, and how they come by
noise in LeRobot 0.6.1: `none` is drawn at inference; `argument`, (B, chunk_size, max_action_dim) float32;
`inside` (xvla accepts a `noise` argument and ignores it); `fixed`, from `config.inference_seed`, observation
by observation."""


@dataclass
class PolicyState:
    """State that the policy side keeps for one trial. Apart from `Trial`: it may be in another process."""

    stream: list[torch.Tensor] | None
    """States of torch's generators, the CPU's and the GPU's, for the trial's next draw; None where the run
    has no seed."""
    policy: PreTrainedPolicy | None = None
    """This trial's instance, for a policy that keeps history in itself."""


class LocalPolicyRunner:
    """A policy with its processors.

    Args:
        policy: a loaded LeRobot policy, in eval mode.
        env_preprocessor: the env type's observation processor.
        env_postprocessor: the env type's action processor.
        preprocessor: the policy's own.
        postprocessor: the policy's own.
        max_batch: slots asked for at once, at most; halved when a GPU runs out of memory.
        in_training: the policy will be trained on. What it keeps from an inference (a cached mask, say) must
            not be barred from autograd then.
        tracebacks: log where the policy raised, the first time; not needed where its inputs are known to
            lack.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
        postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction],
        max_batch: int = 64,
        *,
        in_training: bool = False,
        tracebacks: bool = True,
    ):
        self._policy = policy
        self._config: Any = policy.config
        """Each policy type declares its own options."""
        self._no_grad = torch.no_grad if in_training else torch.inference_mode
        self._env_pre, self._env_post = env_preprocessor, env_postprocessor
        self._pre, self._post = preprocessor, postprocessor
        self.max_batch = max_batch
        kind = getattr(self._config, "type", "")
        self.batched = kind in STATELESS and getattr(self._config, "temporal_ensemble_coeff", None) is None
        self.horizon = int(self._config.n_action_steps) if self.batched else 1
        """Actions executed per call of `act`."""
        self._noise = STATELESS.get(kind, "inside")
        if self._noise == "fixed" and self._config.inference_seed is None:
            self._noise = "inside"
        declared = (getattr(self._config, "output_features", None) or {}).get(ACTION)
        self._width = None if declared is None else int(declared.shape[0])
        self._device = next(policy.parameters()).device
        self._amp = bool(getattr(self._config, "use_amp", False))
        self._idle: list[PreTrainedPolicy] = []
        self._tracebacks = tracebacks
        self._raised: set[str] = set()

    def noise(self, seed: int | None) -> str:
        """How noise is drawn; the value of `TrialRow.noise`.

        Args:
            seed: the run's.
        """
        if seed is None or self._device.type not in ("cpu", "cuda"):
            return "unseeded"
        alone = not self.batched or self.max_batch == 1
        return "per_trial" if alone or self._noise != "inside" else "per_batch"

    @property
    def resumable(self) -> bool:
        """Whether a trial's history follows from its seed and the number of its inferences."""
        return self.batched and self._noise in ("none", "fixed", "argument")

    def start(self, seed: int | None, step: int = 0) -> PolicyState:
        """Returns fresh history for a trial, or resumes a trial that another host lost.

        Args:
            seed: the trial's; None where the run has none.
            step: inferences that the trial has had; 0 unless `resumable`.
        """
        history = PolicyState(None)
        if seed is not None:
            self.reseed(history, seed)
        if not self.batched:
            policy = self._idle.pop() if self._idle else sharing_weights(self._policy)
            policy.reset()
            history.policy = policy
        if step and self._noise == "argument" and history.stream is not None:
            for _ in range(step):
                self._draw(history)
        return history

    def reseed(self, history: PolicyState, seed: int) -> None:
        """Begins a trial's random stream anew; what it remembers stays."""
        with torch.random.fork_rng(devices=self._gpus()):
            torch.manual_seed(seed)
            history.stream = self._stream_state()

    def finish(self, history: PolicyState) -> None:
        if history.policy is not None:
            self._idle.append(history.policy)
            history.policy = None

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[PolicyState],
    ) -> list[Chunk | PolicyError]:
        """One chunk of actions per waiting slot.

        Args:
            observations: raw observation of each slot, unbatched.
            instructions: their language instructions.
            histories: their histories, updated here.

        Returns:
            Arrays (n, A), n being `horizon`; an error in place of each for which the policy raised.
        """
        if not self.batched:
            return [
                self._act_alone(o, i, h)
                for o, i, h in zip(observations, instructions, histories, strict=True)
            ]
        if self._noise == "inside" and len(histories) == 1:
            with self._stream(histories[0]):
                return self._act_together(observations, instructions, None)
        noise = None
        if all(h.stream is not None for h in histories):
            if self._noise == "argument":
                noise = torch.cat([self._draw(h) for h in histories])
            elif self._noise == "inside":
                with self._stream(histories[0]):
                    seed = torch.randint(2**62, ()).item()
                torch.manual_seed(seed)
        return self._act_together(observations, instructions, noise)

    def _act_together(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        noise: torch.Tensor | None,
    ) -> list[Chunk | PolicyError]:
        """Halves a batch that raises until it is known whose observation did it, or until it fits."""
        try:
            return self._predict(observations, instructions, noise)
        except PolicyError as err:  # the same for every observation, whatever the batch
            return [err] * len(observations)
        except torch.cuda.OutOfMemoryError as err:
            torch.cuda.empty_cache()
            if len(observations) > 1:
                self.max_batch = len(observations) // 2
                logger.warning("the GPU is out of memory: at most %d slots a batch from here", self.max_batch)
            problem = PolicyError(f"the GPU is out of memory with a single observation: {err}")
        except Exception as err:  # a policy may raise anything, and it costs its trial alone
            problem = PolicyError(f"{type(err).__name__}: {err}")
            if len(observations) == 1:
                self._warn(str(problem))
        if len(observations) == 1:
            return [problem]
        half = len(observations) // 2
        parts = [slice(None, half), slice(half, None)]
        return [
            chunk
            for p in parts
            for chunk in self._act_together(
                observations[p], instructions[p], None if noise is None else noise[p]
            )
        ]

    def _predict(
        self, observations: Sequence, instructions: Sequence[str], noise: torch.Tensor | None
    ) -> list[Chunk | PolicyError]:
        batch = self._prepare(observations, instructions)
        with self._no_grad(), torch.autocast(self._device.type, enabled=self._amp):
            self._policy.reset()
            extra = {} if noise is None else {"noise": noise}
            chunk = self._policy.predict_action_chunk(batch, **extra)
            self._check(tensor_problem(chunk, len(observations), 3, self._width))
            chunk = chunk[:, : self.horizon]
            steps = [self._actions(chunk[:, i]) for i in range(chunk.shape[1])]
        return list(np.stack(steps, axis=1))

    def _act_alone(
        self, observation: Mapping[str, Any], instruction: str, history: PolicyState
    ) -> Chunk | PolicyError:
        policy = history.policy
        assert policy is not None, "a policy that is asked alone has an instance for each trial"
        try:
            batch = self._prepare([observation], [instruction])
            autocast = torch.autocast(self._device.type, enabled=self._amp)
            with self._stream(history), self._no_grad(), autocast:
                action = policy.select_action(batch)
                self._check(tensor_problem(action, 1, 2, self._width))
                return self._actions(action)
        except PolicyError as err:
            return err
        except Exception as err:  # a policy may raise anything, and it costs its trial alone
            problem = PolicyError(f"{type(err).__name__}: {err}")
            self._warn(str(problem))
            return problem

    def _warn(self, problem: str) -> None:
        """Logs what the policy has just raised, with its traceback the first time."""
        logger.warning(
            "the policy raised %s", problem, exc_info=self._tracebacks and problem not in self._raised
        )
        self._raised.add(problem)

    @property
    def parts(
        self,
    ) -> tuple[
        PreTrainedPolicy,
        PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
        PolicyProcessorPipeline[PolicyAction, PolicyAction],
    ]:
        """The policy, its preprocessor and its postprocessor."""
        return self._policy, self._pre, self._post

    def env_batch(
        self, observations: Sequence[Mapping[str, Any]], instructions: Sequence[str]
    ) -> dict[str, Any]:
        """Observations as the policy's own preprocessor gets them: LeRobot's keys, env processor applied."""
        batch = preprocess_observation(_stack(list(observations)))
        return self._env_pre({**batch, "task": list(instructions)})

    def _prepare(
        self, observations: Sequence[Mapping[str, Any]], instructions: Sequence[str]
    ) -> dict[str, Any]:
        return self._pre(self.env_batch(observations, instructions))

    @staticmethod
    def _check(problem: str) -> None:
        if problem:
            raise PolicyError(problem)

    def _actions(self, action: torch.Tensor) -> np.ndarray:
        """(B, A) of a step, through the postprocessors."""
        batch = len(action)
        action = self._env_post({ACTION: self._post(action)})[ACTION]
        self._check(tensor_problem(action, batch, 2, None))
        action = action.to("cpu")
        # What a processor computes under `use_amp`, which NumPy has no type for.
        return (action.float() if action.dtype is torch.bfloat16 else action).numpy()

    # --- random streams

    def _gpus(self) -> list[torch.device]:
        return [self._device] if self._device.type == "cuda" else []

    def _stream_state(self) -> list[torch.Tensor]:
        return [torch.get_rng_state(), *(torch.cuda.get_rng_state(g) for g in self._gpus())]

    @contextmanager
    def _stream(self, history: PolicyState) -> Generator[None]:
        """torch's global generators stand where the trial left them, and are put back afterwards."""
        if history.stream is None:
            yield
            return
        with torch.random.fork_rng(devices=self._gpus()):
            torch.set_rng_state(history.stream[0])
            for gpu, state in zip(self._gpus(), history.stream[1:], strict=True):
                torch.cuda.set_rng_state(state, gpu)
            try:
                yield
            finally:
                history.stream = self._stream_state()

    def _draw(self, history: PolicyState) -> torch.Tensor:
        """(1, chunk, width) noise: the numbers the policy itself would draw for this trial at batch 1."""
        shape = (1, self._config.chunk_size, self._config.max_action_dim)
        with self._stream(history):
            return torch.normal(0.0, 1.0, shape, dtype=torch.float32, device=self._device)


def sharing_weights[P: torch.nn.Module](policy: P) -> P:
    """A copy with history of its own and the same parameters and buffers, registered ones and others.

    LingBot-VA keeps its frozen VAE and text encoder (20 GB) in a plain dict and loads them at its first
    inference: they are loaded before the first copy is made, once.
    """
    load = getattr(policy, "_ensure_frozen_modules", None)
    if callable(load):
        load()
    shared: dict[int, torch.Tensor] = {}
    _collect_weights(policy, shared, set())
    return copy.deepcopy(policy, dict(shared))


def _collect_weights(value: Any, found: dict[int, torch.Tensor], seen: set[int]) -> None:
    """Weights of every module that `value` holds: in itself, in containers, in LeRobot's plain objects."""
    if id(value) in seen or isinstance(value, (str, bytes, int, float, torch.Tensor, type(None))):
        return
    seen.add(id(value))
    if isinstance(value, torch.nn.Module):
        tensors = (*value.parameters(recurse=False), *value.buffers(recurse=False))
        found.update((id(t), t) for t in tensors)
    if isinstance(value, Mapping):
        parts: Any = value.values()
    elif isinstance(value, (list, tuple)):
        parts = value
    elif isinstance(value, torch.nn.Module) or type(value).__module__.startswith("lerobot"):
        parts = vars(value).values() if hasattr(value, "__dict__") else ()
    else:
        return
    for part in parts:
        _collect_weights(part, found, seen)


def _stack(observations: list[Any]) -> Any:
    if isinstance(observations[0], Mapping):
        return {key: _stack([o[key] for o in observations]) for key in observations[0]}
    return np.stack(observations)
