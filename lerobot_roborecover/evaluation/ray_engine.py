"""The Ray engine: simulators and policy replicas as actors of a cluster, the trial log on the driver.

Slots are those of `workers.cluster`. A trial whose node is lost is run again elsewhere, and so is every trial
whose history was in a lost policy replica.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import ray

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.scheduler import Engine
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.policies.runner import (
    Decision,
    PolicyError,
    PolicyRunner,
    ReplicaHungError,
    ReplicaLostError,
)
from lerobot_roborecover.policies.watchdog import hang_reason
from lerobot_roborecover.utils.determinism import KERNELS
from lerobot_roborecover.workers.backend import Backend, WorkerStartup
from lerobot_roborecover.workers.cluster import ActorGoneError, Cluster, RestartableActor, wait_for_calls


class PolicyActor:
    """Holds a policy and the histories of its trials."""

    def __init__(self, make_host: Callable[[], PolicyRunner]):
        self._make_host = make_host
        self._histories: dict[int, Any] = {}

    def facts(self, seed: int | None) -> tuple[int, bool, str]:
        """Loads the policy; `max_batch`, `batched` and `noise(seed)` of the host."""
        # Here and not above: what an actor's own construction raises looks like the loss of its node.
        self._host = self._make_host()
        return self._host.max_batch, self._host.batched, self._host.noise(seed)

    def start(self, token: int, seed: int | None) -> None:
        """Fresh history under a token."""
        self._histories[token] = self._host.start(seed)

    def finish(self, token: int) -> None:
        self._host.finish(self._histories.pop(token))

    def act(
        self, observations: list, instructions: list[str], tokens: list[int]
    ) -> tuple[Sequence[Decision | PolicyError], int]:
        """`PolicyRunner.act`, and how many may be asked for from here."""
        histories = [self._histories[t] for t in tokens]
        return self._host.act(observations, instructions, histories), self._host.max_batch


class RayReplica(RestartableActor):
    """A policy on the cluster. The histories the engine holds are tokens.

    Args:
        make: makes the actor.
        seed: the run's.
        limit_s: the watchdog: longest that one inference may take before the actor is replaced.
    """

    gone = ""

    def __init__(self, make: Callable[[], Any], seed: int | None, limit_s: float = float("inf")):
        self._limit_s = limit_s
        self.max_batch, self.batched, self._noise = 1, True, ""
        self._tokens = 0
        super().__init__(make, lambda actor: actor.facts.remote(seed))

    @property
    def host(self) -> RayReplica:
        """This replica answers for its host."""
        return self

    def _is_there(self, answer: tuple[int, bool, str]) -> None:
        self.max_batch, self.batched, self._noise = answer

    def noise(self, seed: int | None) -> str:
        """How noise is drawn in the run."""
        return self._noise

    def start(self, seed: int | None) -> int:
        """Fresh history for a trial of that seed."""
        self._tokens += 1
        self._actor.start.remote(self._tokens, seed)
        return self._tokens

    def finish(self, history: int) -> None:
        self._actor.finish.remote(history)

    def submit(self, observations: list, instructions: list[str], histories: list) -> None:
        self.ready = self._actor.act.remote(observations, instructions, histories)
        self.deadline = time.monotonic() + self._limit_s

    def result(self, stop: Callable[[], bool] = lambda: False) -> Sequence[Decision | PolicyError]:
        """Its result.

        Args:
            stop: not asked: the engine calls when the result is there, or overdue.

        Raises:
            ReplicaHungError: the inference has taken too long; another replica is startup.
            ReplicaLostError: the node is gone; another replica is startup.
        """
        overdue, self.deadline = time.monotonic() >= self.deadline, float("inf")
        if overdue and not wait_for_calls([self.ready], 0.0):
            self._start_again()
            raise ReplicaHungError(hang_reason(self._limit_s))
        try:
            chunks, self.max_batch = self._result()
        except ActorGoneError as err:
            raise ReplicaLostError(str(err)) from None
        return chunks


def open_ray_engine(
    run: EvalSession,
    make_host: Callable[[], PolicyRunner],
    workplace: Backend,
    *,
    slots: int,
    replicas: int,
    gpus: float,
    startup: WorkerStartup,
    snapshot_dir: str | None = None,
    most: int | None = None,
    **options: Any,
) -> Engine:
    """Joins a cluster and sizes the engine by it.

    Args:
        run: protocol and trial log; its pool says what slots serve, and has none yet.
        make_host: makes the policy, on the node that runs it.
        workplace: the cluster's address.
        slots: simulators; 0 takes the CPUs that replicas leave over.
        replicas: copies of the policy; 0 takes one per GPU, or one where the policy runs on the CPU.
        gpus: of each replica.
        startup: what simulators do first.
        snapshot_dir: folder of handoff snapshots on a file system that all nodes share; None keeps them in
            each slot's memory.
        most: simulators that have something to do, at most.
        options: of `Engine`.

    Raises:
        OptionError: there is no such cluster, or it lacks what is asked for.
    """
    cluster = Cluster(workplace, run.pool)
    most_replicas = int(cluster.gpus // gpus) if gpus else max(cluster.cpus - 1, 1)
    if workplace.fits:
        replicas = min(replicas, most_replicas)
    replicas = replicas or (most_replicas if gpus else 1)
    if (gpus and replicas * gpus > cluster.gpus) or not replicas:
        raise OptionError(
            f"the policy's {replicas} replicas need {max(replicas, 1) * gpus:g} GPUs; the Ray cluster has "
            f"{cluster.gpus:g}. Use fewer ({workplace.option('replicas')}), or a policy on the CPU "
            f"({workplace.device}=cpu)"
        )
    count = cluster.room(slots, replicas)
    cluster.make_slots(startup)
    run.pool.configure(snapshot_dir=snapshot_dir)
    workers = run.pool.worker_slots(count if most is None else min(count, most))
    # What decides how policies round here decides it there: torch reads these variables when it is loaded.
    chosen = {name: os.environ[name] for name in KERNELS if name in os.environ}
    # `room` has left a CPU to each copy. Ray is not asked for it: once a node is lost, simulators may have
    # all CPUs, and would wait for the policy while it waits for a CPU.
    policy = ray.remote(
        num_cpus=0, num_gpus=gpus, scheduling_strategy="SPREAD", runtime_env={"env_vars": chosen}
    )(PolicyActor)

    def put() -> Any:
        return policy.remote(make_host)

    parts = [RayReplica(put, run.protocol.run_seed, run.policy_watchdog_s) for _ in range(replicas)]
    for part in parts:
        run.pool.on_close(part.close)
    return Engine(run, workers, parts, wait_for_calls, **options)
