"""The Ray engine: simulators and policy replicas as actors of a cluster, the trial log on the driver.

A simulator actor keeps a worker process beside it, so that a simulator which crashes or hangs is handled on
its node as it is locally, and costs its trial. An actor that is gone means that its machine is: the trial it
ran is run again elsewhere, and so is every trial whose history was in a lost policy replica. Nothing that has
finished depends on the cluster: rows are on the driver's disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from lerobot_roborecover.env.options import OptionError
from lerobot_roborecover.env.render_device import egl_devices, node_environment
from lerobot_roborecover.env.run import Run
from lerobot_roborecover.policies.host import Chunk, Host, PolicyError, ReplicaLostError
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.trials.engine import Engine
from lerobot_roborecover.trials.smoke import check_smoke
from lerobot_roborecover.workers.messages import Reply, SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import WorkerSlot

try:
    import ray
    from ray.exceptions import RayError, RayTaskError
except ImportError as err:
    raise OptionError(
        f"--runner.engine=ray: Ray cannot be imported ({err}). pip install 'lerobot_env_roborecover[ray]'"
    ) from err


class ActorGoneError(RuntimeError):
    """An actor is gone, or its result; not what its own code raised, a failed download say."""


class SimulatorActor:
    """Runs one worker slot on whichever node the actor is.

    Args:
        config: what the slot serves.
        timeout_s: its watchdog.
        turn: the simulator's number.
        render_device: where it draws, see `RunnerOptions`.
        smoke: a scenario to draw before the first trial; None where nothing is drawn.
    """

    def __init__(
        self, config: SlotConfig, timeout_s: float, turn: int, render_device: str, smoke: Scenario | None
    ):
        self._config, self._timeout_s = config, timeout_s
        self._turn, self._render_device, self._smoke = turn, render_device, smoke

    def begin(self) -> tuple[str, SlotFailure | None]:
        """Makes the simulator and has it draw: the address of its node, and what went wrong."""
        where = ray.util.get_node_ip_address()
        try:
            chosen = {}
            if self._smoke is not None:
                chosen = node_environment(self._render_device, self._turn, egl_devices())
        except OptionError as err:
            return where, SlotFailure("raised", str(err))
        self._slot = WorkerSlot(replace(self._config, environment=chosen), self._timeout_s)
        reply = self.run(*(("smoke", self._smoke) if self._smoke is not None else ("fingerprint", None)))
        return where, reply if isinstance(reply, SlotFailure) else None

    def run(self, command: str, argument: object) -> Reply:
        """One command of the slot and its reply."""
        self._slot.send(command, argument)
        return self._slot.receive()


class PolicyActor:
    """Holds a policy and the histories of its trials."""

    def __init__(self, make_host: Callable[[], Host]):
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
        """Gives a history back."""
        self._host.finish(self._histories.pop(token))

    def act(
        self, observations: list, instructions: list[str], tokens: list[int]
    ) -> tuple[list[Chunk | PolicyError], int]:
        """`Host.act`, and how many may be asked for from here."""
        histories = [self._histories[t] for t in tokens]
        return self._host.act(observations, instructions, histories), self._host.max_batch


class _Remote:
    """An actor that is made again when it is lost; one call under way at a time.

    Args:
        make: makes the actor.
        first: calls the method whose answer says that it is there.
    """

    deadline = float("inf")

    def __init__(self, make: Callable[[], Any], first: Callable[[Any], Any]):
        self._make, self._first = make, first
        self._open()

    def _open(self) -> None:
        self.opening = True
        self._actor = self._make()
        self.ready = self._first(self._actor)

    def opened(self) -> None:
        """Finds out whether the actor is there; if its node went away meanwhile, begins again."""
        try:
            self._is_there(_get(self.ready))
            self.opening = False
        except ActorGoneError:
            self._open()

    def _is_there(self, answer: Any) -> None:
        """Takes what the first call said."""

    def _result(self) -> Any:
        """Of the call under way.

        Raises:
            ActorGoneError: the actor is gone, and another one is opening.
        """
        try:
            return _get(self.ready)
        except ActorGoneError:
            self._open()
            raise

    def close(self) -> None:
        """Ends the actor."""
        ray.kill(self._actor)


class RaySlot(_Remote):
    """A slot on the cluster."""

    def _is_there(self, answer: tuple[str, SlotFailure | None]) -> None:
        where, failure = answer
        check_smoke(failure, where)

    def send(self, command: str, argument: object = None) -> None:
        """Starts a command."""
        self.ready = self._actor.run.remote(command, argument)

    def receive(self) -> Reply:
        """Its reply; `lost` where the node is gone."""
        try:
            return self._result()
        except ActorGoneError as err:
            return SlotFailure("lost", str(err))


class RayReplica(_Remote):
    """A policy on the cluster. The histories the engine holds are tokens.

    Args:
        make: makes the actor.
        seed: the run's.
    """

    def __init__(self, make: Callable[[], Any], seed: int | None):
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
        """Gives back what a trial held."""
        self._actor.finish.remote(history)

    def ask(self, observations: list, instructions: list[str], histories: list) -> None:
        """Begins an inference."""
        self.ready = self._actor.act.remote(observations, instructions, histories)

    def answer(self) -> list[Chunk | PolicyError]:
        """Its result.

        Raises:
            ReplicaLostError: the node is gone; another replica is opening.
        """
        try:
            chunks, self.max_batch = self._result()
        except ActorGoneError as err:
            raise ReplicaLostError(str(err)) from None
        return chunks


def _get(reference: Any) -> Any:
    """The value of a finished call.

    Raises:
        ActorGoneError: the actor is gone, or its result.
    """
    try:
        return ray.get(reference)
    except RayTaskError:
        raise  # the actor's own code raised
    except RayError as err:
        raise ActorGoneError(f"{type(err).__name__}: {str(err).splitlines()[0]}") from None


def wait(handles: list[Any], timeout_s: float) -> Collection[Any]:
    """Those of the calls that have ended, once any has or the time is up."""
    ready, _ = ray.wait(handles, num_returns=1, timeout=timeout_s)
    return ready


class RayEngine(Engine):
    """Runs units on simulator actors and policy replicas.

    Args:
        run: protocol and trial log; its pool says what slots serve, and starts none itself.
        make_host: makes the policy, on the node that runs it.
        slots: simulators, one CPU each.
        replicas: copies of the policy.
        gpus: of each replica.
        snapshot_dir: folder of handoff snapshots on a file system that all nodes share; None keeps them in
            each slot's memory.
        render_device: where simulators draw, see `RunnerOptions`.
        smoke: a scenario that each simulator draws before its first trial; None where nothing is drawn.
        options: of `Engine`.
    """

    def __init__(
        self,
        run: Run,
        make_host: Callable[[], Host],
        *,
        slots: int,
        replicas: int,
        gpus: float = 0.0,
        snapshot_dir: str | None = None,
        render_device: str = "auto",
        smoke: Scenario | None = None,
        **options: Any,
    ):
        config = replace(run.pool.config, snapshot_dir=snapshot_dir)
        simulator = ray.remote(SimulatorActor).options(num_cpus=1, scheduling_strategy="SPREAD")
        drawing = (render_device, smoke)
        policy = ray.remote(PolicyActor).options(num_cpus=1, num_gpus=gpus)
        parts = [RayReplica(lambda: policy.remote(make_host), run.protocol.run_seed) for _ in range(replicas)]
        seats = [
            RaySlot(
                lambda turn=turn: simulator.remote(config, run.pool.timeout_s, turn, *drawing),
                lambda actor: actor.begin.remote(),
            )
            for turn in range(slots)
        ]
        for part in (*seats, *parts):
            run.pool.on_close(part.close)
        super().__init__(run, seats, parts, wait, **options)


def open_ray_engine(
    run: Run,
    make_host: Callable[[], Host],
    *,
    address: str,
    slots: int,
    replicas: int,
    gpus: float,
    **options: Any,
) -> RayEngine:
    """Joins a cluster and sizes the engine by it.

    Args:
        run: protocol and trial log.
        make_host: makes the policy, on the node that runs it.
        address: the cluster's, or `auto`.
        slots: simulators; 0 takes the CPUs that replicas leave over.
        replicas: copies of the policy; 0 takes one per GPU, or one where the policy runs on the CPU.
        gpus: of each replica.
        options: of `RayEngine`.

    Raises:
        OptionError: there is no such cluster, or it lacks what is asked for.
    """
    if not ray.is_initialized():
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            ray.init(address=address, log_to_driver=False)
        except (ConnectionError, RuntimeError, ValueError) as err:
            raise OptionError(
                f"--runner.ray_address={address}: no Ray cluster there ({err}). Start one with "
                "'ray start --head' and 'ray start --address=HEAD:6379' on the other machines, or use "
                "--runner.engine=local"
            ) from None
        run.pool.on_close(ray.shutdown)
    there = ray.cluster_resources()
    cpus, cards = int(there.get("CPU", 0)), there.get("GPU", 0.0)
    replicas = replicas or (int(cards // gpus) if gpus else 1)
    slots = slots or max(cpus - replicas, 1)
    if (gpus and replicas * gpus > cards) or not replicas:
        raise OptionError(
            f"the policy's {replicas} replicas need {max(replicas, 1) * gpus:g} GPUs; the Ray cluster has "
            f"{cards:g}. Use fewer (--runner.replicas), or --policy.device=cpu"
        )
    if slots + replicas > cpus:
        raise OptionError(
            f"{slots} simulators and {replicas} policy replicas need {slots + replicas} CPUs; the Ray "
            f"cluster has {cpus}. Use --runner.slots={max(cpus - replicas, 1)} or fewer, or add machines"
        )
    return RayEngine(run, make_host, slots=slots, replicas=replicas, gpus=gpus, **options)
