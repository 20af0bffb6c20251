"""The composite policy as `roborecover eval` asks it: slots of different trials, each with its own stream."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.utils.constants import ACTION

from lerobot_roborecover.policies.interventions.controller import InterventionController, InterventionState
from lerobot_roborecover.policies.runner import Act, Decision, PolicyError, Processor, Rollback

_NOISE = ("per_trial", "per_batch", "unseeded")
"""From the best to the worst."""


class InterventionHost:
    """A `policies.runner.PolicyRunner`.

    Args:
        director: the composite policy.
        env_preprocessor: the env type's observation processor.
        env_postprocessor: the env type's action processor.
        preprocessor: the composite policy's own.
        max_batch: slots asked for at once, at most.
    """

    def __init__(
        self,
        director: InterventionController,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: Processor,
        max_batch: int,
    ):
        self._director = director
        self._env_pre, self._env_post, self._pre = env_preprocessor, env_postprocessor, preprocessor
        for member in director.members.values():
            member.max_batch = max_batch

    @property
    def max_batch(self) -> int:
        """That of the member which can take the least."""
        return min(m.max_batch for m in self._director.members.values())

    @property
    def batched(self) -> bool:
        """Whether all members share inferences between slots."""
        return all(m.batched for m in self._director.members.values())

    def noise(self, seed: int | None) -> str:
        """How noise is drawn: as by the member that does worst."""
        return max((m.noise(seed) for m in self._director.members.values()), key=_NOISE.index)

    def start(self, seed: int | None) -> InterventionState:
        return self._director.start(seed)

    def finish(self, history: InterventionState) -> None:
        self._director.finish(history)

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[InterventionState],
    ) -> list[Decision | PolicyError]:
        """One decision per waiting slot, with its mark."""
        prepared: list[dict[str, torch.Tensor] | PolicyError] = []
        for observation, instruction in zip(observations, instructions, strict=True):
            try:
                prepared.append(self._prepare(observation, instruction))
            except Exception as err:  # an observation that cannot be read costs its trial alone
                prepared.append(PolicyError(f"{type(err).__name__}: {err}"))
        good = {i: p for i, p in enumerate(prepared) if not isinstance(p, PolicyError)}
        decisions = self._director.act(
            list(good.values()), [instructions[i] for i in good], [histories[i] for i in good]
        )
        answers = dict(zip(good, decisions, strict=True))
        return [p if isinstance(p, PolicyError) else self._after(answers[i]) for i, p in enumerate(prepared)]

    def _prepare(self, observation: Mapping[str, Any], instruction: str) -> dict[str, torch.Tensor]:
        batch = {**preprocess_observation(_with_batch_axis(observation)), "task": [instruction]}
        return tensors(self._pre(self._env_pre(batch)))

    def _after(self, decision: Act | Rollback | PolicyError) -> Decision | PolicyError:
        """The env type's own treatment of actions, as LeRobot's loop would apply it."""
        if not isinstance(decision, Act):
            return decision
        actions = self._env_post({ACTION: torch.from_numpy(decision.actions.copy())})[ACTION].numpy()
        return replace(decision, actions=actions)


def tensors(batch: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """The observations among a batch's entries."""
    return {k: v for k, v in batch.items() if k.startswith("observation") and isinstance(v, torch.Tensor)}


def _with_batch_axis(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: _with_batch_axis(value) for key, value in observation.items()}
    return np.asarray(observation)[None]
