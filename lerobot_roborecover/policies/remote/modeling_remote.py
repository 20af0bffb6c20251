"""The policy type `roborecover_remote`: action chunks from a server of one of three protocols.

A request is made per slot, and the requests of a batch travel at once. Each slot keeps what it needs of its
trial in a `RemoteTrial`: actions not executed yet, the observations of the mapping's window, and the session
under which a `roborecover serve` at the other end keeps the trial's history and noise.
"""

from __future__ import annotations

import logging
import uuid
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from torch import Tensor, nn

from lerobot_roborecover.policies.remote.configuration_remote import REMOTE, RemoteConfig
from lerobot_roborecover.policies.remote.connection import Request
from lerobot_roborecover.policies.remote.errors import (
    MappingError,
    RemoteError,
    ServerUnavailableError,
    SessionExpiredError,
)
from lerobot_roborecover.policies.remote.mapping import load_mapping
from lerobot_roborecover.policies.remote.modalities import check_modalities
from lerobot_roborecover.policies.remote.servers import make_server
from lerobot_roborecover.policies.remote.sessions import ENVELOPE, PROTOCOL
from lerobot_roborecover.policies.remote.translate import Translator
from lerobot_roborecover.policies.remote.vla_eval import check_specs, wanted
from lerobot_roborecover.policies.runner import Processor

if TYPE_CHECKING:
    from lerobot_roborecover.policies.remote.host import RemoteHost

logger = logging.getLogger(__name__)


@dataclass(eq=False)
class RemoteTrial:
    """One trial, as the client sees it."""

    session: str
    seed: int | None
    """Seed of the trial's noise; used by `roborecover serve` alone."""
    step: int = 0
    """Requests answered so far."""
    frames: deque[dict[str, Any]] = field(default_factory=deque)
    """Translated observations of the mapping's window."""
    actions: deque[np.ndarray] = field(default_factory=deque)
    """Not executed yet."""
    problem: RemoteError | None = None
    """Why the trial is over for the policy."""


class RemotePolicy(PreTrainedPolicy):
    """A policy on a server.

    Args:
        config: address and mapping.

    Raises:
        RemoteError: no server, not the right one, or a mapping that cannot be used.
    """

    # LeRobot declares both as None, for subclasses to replace.
    config_class = RemoteConfig  # ty: ignore[invalid-assignment]
    name = REMOTE  # ty: ignore[invalid-assignment]
    config: RemoteConfig

    def __init__(self, config: RemoteConfig, **kwargs: Any):
        super().__init__(config)
        # LeRobot asks a policy's parameters for its device.
        self._anchor = nn.Parameter(torch.zeros(1), requires_grad=False)
        mapping = load_mapping(config.mapping)
        feature = (config.output_features or {}).get(ACTION)
        width = None if feature is None else int(feature.shape[0])
        self.translator = Translator(mapping, config.n_action_steps, width)
        self.native = mapping.native
        self._reset_message = mapping.reset.message if mapping.reset else None
        self._pinned = mapping.protocol == "vla_eval"
        self.server = make_server(config, mapping)
        weakref.finalize(self, self.server.close)
        self._client, self._numbers = uuid.uuid4().hex, count()
        self._slots: list[RemoteTrial] | None = None
        self._outages = 0
        self._checked = False
        try:
            metadata = self.server.reach()
            if self.native:
                self._check_server(metadata)
            if self._pinned:
                check_specs(metadata, mapping.specs, width, config.url)
                self.translator.flags = wanted(metadata)
            if mapping.protocol == "gr00t":
                check_modalities(metadata, mapping, self.translator.execute, config.url)
        except RemoteError:
            self.server.close()
            raise
        logger.info("policy server %s: %s", config.url, _shown(metadata))

    # --- LeRobot's interface

    def reset(self) -> None:
        """Ends the trials of the last rollout."""
        for slot in self._slots or ():
            self.close_slot(slot)
        self._slots = None

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) actions; NaN, which no simulator is sent, for a trial whose request was refused.

        At batch 1 a trial's noise starts, on a `roborecover serve`, from torch's seed: what the policy would
        draw here.

        Raises:
            ServerUnavailableError, SessionExpiredError: the server, or its memory of a trial, is lost. The
                policy did not fail: the evaluation stops, and the same command goes on with it.
        """
        observations, tasks = split(batch)
        if self._slots is None or len(self._slots) != len(observations):
            self.reset()
            seed = torch.initial_seed()
            self._slots = [self.open_slot((seed + i) % 2**63) for i in range(len(observations))]
        width = (self.config.output_features or {})[ACTION].shape[0]
        actions = self.advance(observations, tasks, self._slots)
        for action in actions:
            if isinstance(action, ServerUnavailableError | SessionExpiredError):
                raise action
        rows = [np.full(width, np.nan, np.float32) if isinstance(a, RemoteError) else a for a in actions]
        return torch.from_numpy(np.stack(rows))

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, n, A) actions, each slot asked without a history.

        Raises:
            RemoteError: a request failed, or the chunks differ in length.
        """
        observations, tasks = split(batch)
        slots = [self.open_slot(int(torch.randint(2**62, ()))) for _ in observations]
        chunks = self.ask(observations, tasks, slots)
        for slot in slots:
            self.close_slot(slot)
        whole: list[np.ndarray] = []
        for chunk in chunks:
            if isinstance(chunk, RemoteError):
                raise chunk
            whole.append(chunk)
        if len({c.shape for c in whole}) > 1:
            raise RemoteError(f"the server gave chunks of different shapes: {[c.shape for c in whole]}")
        return torch.from_numpy(np.stack(whole))

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        """Not possible.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a remote policy is not trained here: its weights are on the server")

    def get_optim_params(self) -> dict:
        return {}

    def make_host(
        self,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: Processor,
        max_batch: int = 64,
    ) -> RemoteHost:
        """The policy as `roborecover eval` asks it.

        Args:
            env_preprocessor: the env type's observation processor.
            env_postprocessor: the env type's action processor.
            preprocessor: the policy type's.
            max_batch: slots asked for at once, at most.
        """
        from lerobot_roborecover.policies.remote.host import RemoteHost

        return RemoteHost(self, env_preprocessor, env_postprocessor, preprocessor, max_batch)

    # --- trials

    def open_slot(self, seed: int | None) -> RemoteTrial:
        """A fresh trial.

        Args:
            seed: of its noise; None draws what the server draws.
        """
        return RemoteTrial(f"{self._client}-{next(self._numbers)}", seed)

    def close_slot(self, slot: RemoteTrial) -> None:
        """Ends a trial: a `roborecover serve` forgets its history."""
        if self.native and slot.step:
            self.server.tell(Request({ENVELOPE: {"session": slot.session, "end": True}}))
            slot.step = 0
        if self._pinned and slot.step:
            self.server.tell(Request({}, session=slot.session, end=True))
            slot.step = 0

    def advance(
        self,
        observations: Sequence[Mapping[str, np.ndarray]],
        tasks: Sequence[str],
        slots: Sequence[RemoteTrial],
    ) -> list[np.ndarray | RemoteError]:
        """One (A,) action per slot; the server is asked for those that have none left."""
        if self.translator.frames > 1:
            for observation, slot in zip(observations, slots, strict=True):
                self._see(slot, observation)
        empty = [i for i, s in enumerate(slots) if not s.actions and s.problem is None]
        if empty:
            chunks = self._answers([tasks[i] for i in empty], [slots[i] for i in empty], observations, empty)
            for index, chunk in zip(empty, chunks, strict=True):
                if isinstance(chunk, RemoteError):
                    slots[index].problem = chunk
                    logger.warning("policy error: %s", chunk)
                else:
                    slots[index].actions.extend(chunk)
        return [s.problem if s.problem is not None else s.actions.popleft() for s in slots]

    def ask(
        self,
        observations: Sequence[Mapping[str, np.ndarray]],
        tasks: Sequence[str],
        slots: Sequence[RemoteTrial],
    ) -> list[np.ndarray | RemoteError]:
        """An (n, A) chunk per slot, to be executed whole.

        Args:
            observations: of `split`.
            tasks: the slots' instructions.
            slots: the trials.

        Raises:
            MappingError: the observations do not fit the mapping, or the server.
            ServerUnavailableError: the server has not answered `give_up_after` times in a row.
        """
        return self._answers(tasks, slots, observations, range(len(slots)))

    def _answers(
        self,
        tasks: Sequence[str],
        slots: Sequence[RemoteTrial],
        observations: Sequence[Mapping[str, np.ndarray]],
        indices: Sequence[int],
    ) -> list[np.ndarray | RemoteError]:
        requests = []
        for slot, task, index in zip(slots, tasks, indices, strict=True):
            if self.translator.frames == 1 or not slot.frames:
                self._see(slot, observations[index])
            payload = self._payload(slot, task)
            if self.native:
                payload[ENVELOPE] = {"session": slot.session, "seed": slot.seed, "step": slot.step}
            prelude = None if slot.step else self._reset_message
            repeat = (self.translator.execute or 1) if self._pinned else 1
            requests.append(Request(payload, prelude, slot.session, slot.step, task, repeat))
        answers = self.server.ask(requests)
        self._count_outage(answers)
        return [self._actions(slot, answer) for slot, answer in zip(slots, answers, strict=True)]

    def _payload(self, slot: RemoteTrial, task: str) -> dict[str, Any]:
        payload = self.translator.request(slot.frames, task)
        mapping = self.translator.mapping
        if mapping.protocol == "gr00t" and mapping.argument:
            return {mapping.argument: payload}
        return payload

    def _see(self, slot: RemoteTrial, observation: Mapping[str, np.ndarray]) -> None:
        if not self._checked:
            self._check_observation(observation)
            self._checked = True
        frame = self.translator.frame(observation)
        missing = self.translator.frames - len(slot.frames)
        slot.frames.extend([frame] * (missing if not slot.frames else 1))
        while len(slot.frames) > self.translator.frames:
            slot.frames.popleft()

    def _actions(self, slot: RemoteTrial, answer: Any) -> np.ndarray | RemoteError:
        if isinstance(answer, RemoteError):
            return answer
        slot.step += 1
        try:
            return self.translator.actions(answer)
        except RemoteError as err:
            return err

    def _count_outage(self, answers: Sequence[Any]) -> None:
        away = [a for a in answers if isinstance(a, ServerUnavailableError)]
        self._outages = self._outages + 1 if len(away) == len(answers) else 0
        limit = self.config.give_up_after
        if limit and self._outages >= limit:
            self.server.close()
            raise ServerUnavailableError(
                f"{away[-1]}. No answer {limit} times in a row (--policy.give_up_after), so the run "
                "stops here; once the server is back, the same command goes on"
            )

    # --- does it fit

    def _check_server(self, metadata: Mapping[str, Any]) -> None:
        url = self.config.url
        if metadata.get("server") != "roborecover":
            raise MappingError(
                f"--policy.mapping={self.config.mapping} is for 'roborecover serve'; {url} introduces itself "
                f"as {_shown(metadata)}. Choose the mapping of that server"
            )
        if metadata.get("protocol") != PROTOCOL:
            raise MappingError(
                f"{url} speaks version {metadata.get('protocol')!r:.40} of the session protocol, this side "
                f"version {PROTOCOL}: install the same RoboRecover on both machines"
            )
        feature = (self.config.output_features or {}).get(ACTION)
        width = metadata.get("action_width")
        if feature is not None and width != feature.shape[0]:
            raise MappingError(
                f"the policy at {url} has actions of width {width!r:.40}, the environment takes "
                f"{feature.shape[0]}: it was trained for another platform, or another action mode"
            )

    def _check_observation(self, observation: Mapping[str, np.ndarray]) -> None:
        mapping = self.translator.mapping
        sizes = {observation[i.source].shape[1:] for i in mapping.images if i.source in observation}
        if mapping.render and sizes - {mapping.render}:
            logger.warning(
                "%s is made for pictures of %d x %d, and gets %s: --env.observation_height=%d "
                "--env.observation_width=%d", mapping.about, *mapping.render, sorted(sizes), *mapping.render,
            )  # fmt: skip
        if self.native:
            self._check_features(observation)

    def _check_features(self, observation: Mapping[str, np.ndarray]) -> None:
        wanted = self.server.metadata.get("observation")
        if not isinstance(wanted, dict):
            return
        for key, shape in wanted.items():
            if key not in observation:
                remedy = (
                    "Start the server with --rename_map, or change the env's cameras and observation type"
                )
                if key == OBS_ENV_STATE:
                    remedy = "Give --env.obs_type=state"
                raise MappingError(
                    f"the policy at {self.config.url} looks at {sorted(wanted)}; the environment gives "
                    f"{sorted(observation)}. {remedy}"
                )
            have = observation[key].shape
            if len(shape) == 1 and list(shape) != list(have):
                raise MappingError(
                    f"the policy at {self.config.url} takes {key} of shape {shape}, the environment gives "
                    f"{list(have)}"
                )

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> RemotePolicy:
        """A saved remote policy is its configuration alone; there are no weights here to load."""
        config = kwargs.get("config") or RemoteConfig.from_pretrained(pretrained_name_or_path)
        return cls(config)


def split(batch: Mapping[str, Any]) -> tuple[list[dict[str, np.ndarray]], list[str]]:
    """A batch's observations and instructions, slot by slot.

    Args:
        batch: LeRobot's, after the env's processor: tensors under `observation.*`, and `task`.
    """
    arrays = {
        key: value.detach().to("cpu").numpy()
        for key, value in batch.items()
        if key.startswith("observation.") and isinstance(value, Tensor)
    }
    if not arrays:
        raise MappingError(f"no observation in a batch of {sorted(batch)}")
    size = min(len(a) for a in arrays.values())
    tasks = batch.get("task")
    tasks = [tasks] * size if isinstance(tasks, str) else list(tasks) if tasks else [""] * size
    return [{key: array[i] for key, array in arrays.items()} for i in range(size)], tasks


def _shown(metadata: Mapping[str, Any]) -> str:
    return f"{dict(metadata)!r:.300}"
