"""Slots on a Ray cluster: each is an actor with a worker process on the same node.

A simulator that crashes or hangs is therefore handled on its node as it is locally, and costs only the item
at hand. An actor that is gone means that its machine is gone: the item is lost, and the caller sends it to
another slot. Finished results do not depend on the cluster: this process writes them.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from lerobot_roborecover._version import __version__
from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.platforms.versions import installed, required
from lerobot_roborecover.utils.text import install_command
from lerobot_roborecover.workers.backend import Backend, WorkerStartup
from lerobot_roborecover.workers.messages import Reply, SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import SlotPool, WorkerSlot

try:
    import ray
    from ray.exceptions import RayError, RayTaskError
except ImportError as err:
    raise OptionError(f"engine=ray: Ray cannot be imported ({err}). {install_command('ray')}") from err

MOST_OPENINGS = 3
"""How often in a row an actor may fail to open: a node may go while it starts, but not every time."""


_KNOCK_S = 20.0


class ActorGoneError(RuntimeError):
    """An actor is gone, or its result; not what its own code raised, a failed download say."""


class ClusterError(RoboRecoverError):
    """A cluster's nodes cannot do the work."""


@dataclass(frozen=True)
class _NodeFacts:
    """What an actor says of its node."""

    where: str
    """Its address."""
    versions: Mapping[str, str]
    """Versions of what decides results there."""
    failure: SlotFailure | None
    """Failure of the first command."""


def result_of(reference: Any) -> Any:
    """The value of a finished call.

    Raises:
        ActorGoneError: the actor is gone, or its result.
    """
    try:
        return ray.get(reference)
    except RayTaskError as err:  # the actor's own code raised
        if isinstance(err.cause, RoboRecoverError):
            raise err.cause from None
        raise
    except RayError as err:
        raise ActorGoneError(f"{type(err).__name__}: {str(err).splitlines()[0]}") from None


def wait_for_calls(handles: list[Any], timeout_s: float) -> Collection[Any]:
    """Those of the calls that have ended, once any has or the time is up."""
    ready, _ = ray.wait(handles, num_returns=1, timeout=timeout_s)
    return ready


class RestartableActor:
    """An actor that is made again when it is lost; one call under way at a time.

    Args:
        make: makes the actor.
        first: calls the method whose answer says that it is there.
    """

    deadline = float("inf")

    def __init__(self, make: Callable[[], Any], first: Callable[[Any], Any]):
        self._make, self._first = make, first
        self._failed = 0
        self._start()

    def _start(self) -> None:
        self.starting = True
        self._actor = self._make()
        self.ready = self._first(self._actor)

    def _start_again(self) -> None:
        self.close()
        self._start()

    def poll_startup(self) -> None:
        """Finds out whether the actor is there; if its node went away meanwhile, begins again.

        Raises:
            ClusterError: it has gone away too often.
        """
        try:
            answer = result_of(self.ready)
        except ActorGoneError as err:
            self._failed += 1
            if self._failed >= MOST_OPENINGS:
                raise ClusterError(
                    f"a part of the run could not be started on the Ray cluster, {self._failed} times in a "
                    f"row; the last time: {err}. Every node needs this package with its extras, in the same "
                    "version, and memory for a simulator per CPU"
                ) from None
            self._start_again()
            return
        self._is_there(answer)
        self._failed, self.starting = 0, False

    def _is_there(self, answer: Any) -> None:
        """Takes what the first call said."""

    def _result(self) -> Any:
        """Of the call under way.

        Raises:
            ActorGoneError: the actor is gone, and another one is startup.
        """
        try:
            return result_of(self.ready)
        except ActorGoneError:
            self._start_again()
            raise

    def close(self) -> None:
        """Ends the actor, if it is still there."""
        ray.kill(self._actor)


class SlotActor:
    """Runs one worker slot on whichever node the actor is.

    Args:
        config: what the slot serves.
        timeout_s: its watchdog.
        turn: the slot's number.
        environment, first: of `WorkerStartup`.
    """

    def __init__(self, config: SlotConfig, timeout_s: float, turn: int, environment: Any, first: Any):
        self._config, self._timeout_s, self._turn = config, timeout_s, turn
        self._environment, self._first = environment, first

    def begin(self) -> _NodeFacts:
        """Makes the slot, and has it do its first command."""
        where, versions = ray.util.get_node_ip_address(), decisive_versions(self._config.platform)
        chosen = {**self._config.environment}
        try:
            if self._environment is not None:
                chosen |= self._environment(self._turn)
        except OptionError as err:
            return _NodeFacts(where, versions, SlotFailure("raised", str(err)))
        self._slot = WorkerSlot(replace(self._config, environment=chosen), self._timeout_s)
        reply = None if self._first is None else self.run(*self._first)
        return _NodeFacts(where, versions, reply if isinstance(reply, SlotFailure) else None)

    def run(self, command: str, argument: object) -> Reply:
        """One command of the slot and its reply."""
        self._slot.send(command, argument)
        return self._slot.receive()

    def end(self) -> None:
        """Ends the slot's process; the next command starts another."""
        self._slot.end()


class RaySlot(RestartableActor):
    """A slot on the cluster.

    Args:
        make: makes the actor.
        platform: of its simulator.
        check: of `WorkerStartup`.
    """

    wait = staticmethod(wait_for_calls)

    def __init__(
        self, make: Callable[[], Any], platform: str, check: Callable[[SlotFailure | None, str], None]
    ):
        self._platform, self._check, self._working = platform, check, False
        super().__init__(make, lambda actor: actor.begin.remote())

    def _is_there(self, answer: _NodeFacts) -> None:
        here = decisive_versions(self._platform)
        other = [
            f"{name} {answer.versions.get(name) or 'not at all'} (here {version or 'not at all'})"
            for name, version in here.items()
            if answer.versions.get(name) != version
        ]
        if other:
            raise ClusterError(
                f"node {answer.where} of the Ray cluster has {', '.join(other)}: its results would be "
                "others. Install the same versions on every node"
            )
        self._check(answer.failure, answer.where)

    def send(self, command: str, argument: object = None) -> None:
        """Starts a command, once the slot is open."""
        while self.starting:
            self.poll_startup()
        self.ready, self._working = self._actor.run.remote(command, argument), True

    def receive(self) -> Reply:
        """Its reply; `lost` where the node is gone."""
        self._working = False
        try:
            return self._result()
        except ActorGoneError as err:
            return SlotFailure("lost", str(err))

    def end(self) -> None:
        """Ends the worker process at once, whatever it does; the next command starts another."""
        if self._working:  # its actor hears of nothing else until that is done
            self._working = False
            self._start_again()
        elif not self.starting:
            self._actor.end.remote()


def decisive_versions(platform: str) -> dict[str, str]:
    """Of what decides a simulator's results, on the machine where this is called.

    Args:
        platform: of the simulator; empty for this package's version alone.
    """
    found = {"lerobot_env_roborecover": __version__}
    return found | {name: installed(name) or "" for name in (required(platform) if platform else ())}


def _check_reachable(address: str) -> None:
    """Raises an `OSError` where no server answers at HOST:PORT; Ray itself would retry for minutes."""
    host, _, port = address.rpartition(":")
    if "/" not in host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_KNOCK_S).close()


class Cluster:
    """A Ray cluster that a pool's slots are on, joined as long as the pool is open.

    Args:
        workplace: its address, and what options are called.
        pool: whose slots.

    Raises:
        OptionError: there is no such cluster.
    """

    def __init__(self, workplace: Backend, pool: SlotPool):
        self._workplace, self._pool = workplace, pool
        if not ray.is_initialized():
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            try:
                _check_reachable(workplace.address)
                ray.init(address=workplace.address, log_to_driver=False)
            except (OSError, RuntimeError, ValueError) as err:
                option = workplace.option
                raise OptionError(
                    f"{option('ray_address')}={workplace.address}: no Ray cluster there ({err}). Start one "
                    "with 'ray start --head' and 'ray start --address=HEAD:6379' on the other machines, or "
                    f"use {option('engine')}=local"
                ) from None
            pool.on_close(ray.shutdown)
        there = ray.cluster_resources()
        self.cpus, self.gpus = int(there.get("CPU", 0)), there.get("GPU", 0.0)

    def room(self, slots: int, replicas: int = 0) -> int:
        """How many slots there may be.

        Args:
            slots: asked for; 0 takes all CPUs that are left over.
            replicas: of a policy, a CPU each.

        Raises:
            OptionError: the cluster has fewer CPUs.
        """
        left = max(self.cpus - replicas, 1)
        slots = min(slots or left, left) if self._workplace.fits else slots or left
        if slots + replicas > self.cpus:
            beside = f" and {replicas} policy replicas" if replicas else ""
            raise OptionError(
                f"{slots} simulators{beside} need {slots + replicas} CPUs; the Ray cluster has {self.cpus}. "
                f"Use {self._workplace.option(self._workplace.count)}={left} or fewer, or add machines"
            )
        return slots

    def make_slots(self, startup: WorkerStartup) -> None:
        """Has the pool's slots made on the cluster, one CPU each, spread over its nodes."""
        actor = ray.remote(num_cpus=1, scheduling_strategy="SPREAD")(SlotActor)

        def make(config: SlotConfig, timeout_s: float, turn: int) -> RaySlot:
            def put() -> Any:
                return actor.remote(config, timeout_s, turn, startup.environment, startup.first)

            return RaySlot(put, config.platform, startup.check)

        self._pool.make_with(make)
