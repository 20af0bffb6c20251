"""A remote policy as `roborecover eval` asks it: every waiting slot's request at once, a history per slot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.envs import preprocess_observation
from lerobot.utils.constants import ACTION

from lerobot_roborecover.policies.remote.errors import (
    RemoteError,
    ServerUnavailableError,
    SessionExpiredError,
)
from lerobot_roborecover.policies.remote.modeling_remote import RemotePolicy, RemoteTrial, split
from lerobot_roborecover.policies.runner import Chunk, PolicyError, PolicyUnavailableError, Processor


class RemoteHost:
    """`trials.host.PolicyRunner` over a policy server.

    Args:
        policy: connected.
        env_preprocessor: the env type's observation processor.
        env_postprocessor: the env type's action processor.
        preprocessor: the policy type's.
        max_batch: slots asked for at once, at most.
    """

    batched = True

    def __init__(
        self,
        policy: RemotePolicy,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: Processor,
        max_batch: int = 64,
    ):
        self._policy = policy
        self._env_pre, self._env_post = env_preprocessor, env_postprocessor
        self._pre = preprocessor
        self.max_batch = max_batch

    def noise(self, seed: int | None) -> str:
        """How noise is drawn: as a `roborecover serve` says; any other server draws as it likes."""
        drawn = self._policy.server.metadata.get("noise") if self._policy.native else None
        return drawn if seed is not None and drawn in ("per_trial", "per_batch") else "unseeded"

    def start(self, seed: int | None) -> RemoteTrial:
        return self._policy.open_slot(seed)

    def finish(self, history: RemoteTrial) -> None:
        """Ends a trial on the server."""
        self._policy.close_slot(history)

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[RemoteTrial],
    ) -> list[Chunk | PolicyError]:
        """One chunk per waiting slot; single steps where the server wants the steps before.

        Raises:
            MappingError: the observations do not fit.
            ServerUnavailableError: the server stays away, and the run is to stop.
        """
        batch = {**preprocess_observation(_stack(list(observations))), "task": list(instructions)}
        frames, tasks = split(self._pre(self._env_pre(batch)))
        if self._policy.translator.frames > 1:
            chunks = self._policy.advance(frames, tasks, histories)
            chunks = [c if isinstance(c, RemoteError) else c[None] for c in chunks]
        else:
            chunks = self._policy.ask(frames, tasks, histories)
        return [_error(c) if isinstance(c, RemoteError) else self._executable(c) for c in chunks]

    def _executable(self, chunk: np.ndarray) -> np.ndarray:
        action = self._env_post({ACTION: torch.from_numpy(chunk)})[ACTION]
        return action.to("cpu").numpy()


def _error(problem: RemoteError) -> PolicyError:
    """What a request's failure says of the policy: nothing, where it never got there."""
    away = isinstance(problem, ServerUnavailableError | SessionExpiredError)
    return (PolicyUnavailableError if away else PolicyError)(str(problem))


def _stack(observations: list[Any]) -> Any:
    if isinstance(observations[0], Mapping):
        return {key: _stack([o[key] for o in observations]) for key in observations[0]}
    return np.stack(observations)
