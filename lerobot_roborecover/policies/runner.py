"""Interface between an engine and a policy; imports neither LeRobot nor torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from lerobot_roborecover.policies.action_checks import count_problem
from lerobot_roborecover.policies.watchdog import (
    CallStoppedError,
    CallTimeoutError,
    PolicyThread,
    hang_reason,
)


class PolicyError(RuntimeError):
    """The policy raised, or what it gave cannot be executed."""


class PolicyUnavailableError(PolicyError):
    """The way to the policy is lost, or what it remembered of the trial: nothing is known of what it would
    have done, and the trial is to be run again."""


class ReplicaLostError(RuntimeError):
    """The process that held the policy is gone, and the history of its trials with it."""


class ReplicaHungError(ReplicaLostError):
    """The policy took longer over an inference than the watchdog allows: what it was asked about has failed,
    and the histories of its other trials are lost."""


BY_RULE = -1
"""A rollback's number of steps, written for `None`: the paper's number for the task."""


class Controller(IntEnum):
    """Who chose an action."""

    BASE = 0
    CORRECTION = 1
    HUMAN = 2


@dataclass(frozen=True)
class InterventionMark:
    """What a policy that intervenes says beside a decision, for the trial's row."""

    controller: Controller = Controller.BASE
    asked: bool = False
    """Whether the monitor was asked about the observation that the decision answers."""
    score: float = float("nan")
    """The monitor's; NaN where it was not asked or its answer could not be read."""
    monitor_s: float = 0.0
    """Seconds that the monitor took, shared by the batch."""


@dataclass(frozen=True)
class Act:
    """A decision to execute actions without looking in between."""

    actions: np.ndarray
    """(n, A)."""
    mark: InterventionMark | None = None
    """Mark of the first action; its controller chose them all. None where the policy does not intervene."""


@dataclass(frozen=True)
class Rollback:
    """A decision to put the simulation some steps back instead of acting."""

    steps: int | None
    """How many, at least 1; None takes the paper's number for the task."""
    mark: InterventionMark = field(default_factory=InterventionMark)


type Chunk = np.ndarray
"""(n, A) actions: an `Act` without a mark."""
type Decision = Chunk | Act | Rollback
"""A policy's answer about a trial."""


def decision_of(answer: Chunk | Act | Rollback) -> Act | Rollback:
    """Returns a policy's answer as a decision; what is no decision is the actions of one, unchecked."""
    return answer if isinstance(answer, Act | Rollback) else Act(answer)


type Processor = Callable[[dict[str, Any]], dict[str, Any]]
"""An env type's, of observations or of actions: a batch by LeRobot's keys to another."""


class ReplicaHost(Protocol):
    """A policy runner that keeps a history per trial."""

    @property
    def max_batch(self) -> int:
        """Slots asked for at once, at most."""

    @property
    def batched(self) -> bool:
        """Whether slots share inferences."""

    def noise(self, seed: int | None) -> str:
        """How noise is drawn in a run of that seed; the value of `TrialRow.noise`."""

    def start(self, seed: int | None) -> Any:
        """Fresh history for a trial of that seed."""

    def finish(self, history: Any) -> None:
        """Gives back what a trial held."""


class PolicyRunner(ReplicaHost, Protocol):
    """A policy with its processors, which keeps a history per trial."""

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[Any],
    ) -> Sequence[Decision | PolicyError]:
        """One decision per waiting slot; an error in its place where the policy raised for it, or cannot be
        reached (`PolicyUnavailableError`)."""


@runtime_checkable
class ProvidesRunner(Protocol):
    """A policy that is asked through a host of its own: it keeps histories itself."""

    def make_host(
        self,
        env_preprocessor: Processor,
        env_postprocessor: Processor,
        preprocessor: Processor,
        max_batch: int,
    ) -> PolicyRunner:
        """Its host.

        Args:
            env_preprocessor: the env type's observation processor.
            env_postprocessor: the env type's action processor.
            preprocessor: the policy type's.
            max_batch: slots asked for at once, at most.
        """


class Replica(Protocol):
    """A host that is asked first and answers later, so that an engine can wait for several at once."""

    @property
    def host(self) -> ReplicaHost:
        """The host that serves batches of trials."""

    @property
    def starting(self) -> bool:
        """Whether it cannot be asked yet; `ready` then says when to call `poll_startup`."""

    @property
    def gone(self) -> str:
        """Why it can never be asked again; empty while it can."""

    @property
    def ready(self) -> Any:
        """What the engine's wait function waits on for the answer; True where it need not wait."""

    @property
    def deadline(self) -> float:
        """When the inference under way counts as hung, on the engine's clock."""

    def poll_startup(self) -> None:
        """Finds out whether the opening has worked; it may have begun again."""

    def submit(self, observations: list, instructions: list[str], histories: list) -> None:
        """Begins an inference."""

    def result(self, stop: Callable[[], bool]) -> Sequence[Decision | PolicyError] | None:
        """Its result.

        Args:
            stop: asked while the inference is waited for.

        Returns:
            One answer per observation; None where `stop` came first.

        Raises:
            ReplicaHungError: the inference has taken too long.
            ReplicaLostError: with every history that it held; it opens again by itself.
        """


class InlineReplica:
    """A host in this process: it infers when the answer is asked for, on a thread that can be left behind.

    Args:
        host: the policy.
        thread: where it infers.
        limit_s: the watchdog: longest that one inference may take.
    """

    starting = False
    ready = True
    deadline = float("inf")

    def __init__(self, host: PolicyRunner, thread: PolicyThread | None = None, limit_s: float = float("inf")):
        self.host = host
        self.gone = ""
        self._thread, self._limit_s = thread or PolicyThread(), limit_s
        self._asked: tuple[list, list[str], list] = ([], [], [])

    def poll_startup(self) -> None:
        """Nothing to find out."""

    def submit(self, observations: list, instructions: list[str], histories: list) -> None:
        self._asked = (observations, instructions, histories)

    def result(self, stop: Callable[[], bool] = lambda: False) -> Sequence[Decision | PolicyError] | None:
        """Infers.

        Args:
            stop: asked meanwhile.

        Raises:
            ReplicaHungError: the inference has taken too long; the replica is then gone.
        """
        infer = partial(self.host.act, *self._asked)
        try:
            return self._thread.call(infer, limit_s=self._limit_s, stop=stop)
        except CallStoppedError:
            self.gone = "the run was stopped during an inference"
            return None
        except CallTimeoutError:
            self.gone = hang_reason(self._limit_s)
            raise ReplicaHungError(self.gone) from None


class WatchedHost:
    """A host whose inferences the watchdog ends, for a caller that asks directly, without an engine.

    Args:
        host: the policy.
        limit_s: longest that one inference may take.
    """

    def __init__(self, host: PolicyRunner, limit_s: float):
        self._host, self._thread = host, PolicyThread()
        self._replica = InlineReplica(host, self._thread, limit_s)

        self.batched = host.batched
        self.horizon = getattr(host, "horizon", 1)

    @property
    def max_batch(self) -> int:
        return self._host.max_batch

    def noise(self, seed: int | None) -> str:
        return self._host.noise(seed)

    def start(self, seed: int | None) -> Any:
        return self._host.start(seed)

    def finish(self, history: Any) -> None:
        self._host.finish(history)

    def act(
        self,
        observations: Sequence[Mapping[str, Any]],
        instructions: Sequence[str],
        histories: Sequence[Any],
    ) -> Sequence[Decision | PolicyError]:
        """One answer per observation; an error for each where an inference has hung, now or before."""
        if not self._replica.gone:
            self._replica.submit(list(observations), list(instructions), list(histories))
            try:
                answers = self._replica.result() or []
            except ReplicaHungError:
                pass
            else:
                problem = count_problem(len(answers), len(observations))
                return [PolicyError(problem)] * len(observations) if problem else answers
        return [PolicyError(self._replica.gone)] * len(observations)

    def close(self) -> None:
        self._thread.close()
