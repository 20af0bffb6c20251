"""Functions run in worker processes, each with its simulators: replays, pictures, checks, conversions.

Making a simulator compiles its task (6 s of CPU on LIBERO), and what writes episodes imports LeRobot (11 to
22 s), so a process and its simulators are kept from job to job, and from one use of the pool to the next;
except where jobs must share nothing (`fresh`). One which crashes or hangs is only its own end either way.
"""

from __future__ import annotations

import importlib
import json
import math
import pickle
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.workers.backend import LOCAL, Backend
from lerobot_roborecover.workers.dispatch import map_ordered, map_unordered
from lerobot_roborecover.workers.messages import SlotConfig, SlotFailure
from lerobot_roborecover.workers.slots import SimulatorWorker, SlotPool

SERVER = f"{__name__}:JobServer"
_MOST_SIMULATORS = 3
"""Of a worker process: jobs may ask for other options than the pool's."""


@dataclass(frozen=True)
class Job:
    """A function to run."""

    work: str
    """`module:function`."""
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Done:
    """Reply to a job: what the function returned."""

    value: Any


@dataclass(frozen=True)
class JobError:
    """Reply to a job: what the function raised."""

    error: Exception
    """As it was, where it can travel; else a `RuntimeError` of its words."""

    @property
    def words(self) -> str:
        """For people: a refusal says itself what it is about, anything else begins with its type."""
        plain = isinstance(self.error, RoboRecoverError)
        return str(self.error) if plain else f"{type(self.error).__name__}: {self.error}"


type Outcome = Done | JobError | SlotFailure


class JobServer:
    """Runs jobs in a worker process.

    Args:
        config: platform and options of the simulators, which are made when a job first asks for them.
    """

    def __init__(self, config: SlotConfig):
        global _server
        self._config = config
        self._simulators: dict[str, Simulator] = {}
        _server = self

    def simulator(self, options: Mapping[str, Any] | None) -> Simulator:
        """See `simulator_of_worker`."""
        options = self._config.options if options is None else options
        name, kept = json.dumps(options, sort_keys=True, default=str), self._simulators
        if name not in kept:
            if len(kept) == _MOST_SIMULATORS:
                kept.pop(next(iter(kept))).close()
            kept[name] = make_simulator(self._config.platform, **options)
        return kept[name]

    def answer(self, command: str, argument: Job) -> Done | JobError:
        """Runs a job; the only command is `run`."""
        assert command == "run", command
        try:
            module, _, name = argument.work.partition(":")
            work = getattr(importlib.import_module(module), name)
            return Done(work(*argument.arguments))
        except Exception as err:
            traceback.print_exc()
            return JobError(_picklable(err))

    def close(self) -> None:
        while self._simulators:
            self._simulators.popitem()[1].close()


_server: JobServer | None = None


def simulator_of_worker(options: Mapping[str, Any] | None = None) -> Simulator:
    """A simulator of this worker process, made when first asked for; the oldest of several makes room.

    Args:
        options: None takes the pool's.
    """
    assert _server is not None, "not in a worker process"
    return _server.simulator(options)


def drop_simulators_of_worker() -> None:
    """Closes them all: the next job gets one that nothing has gone wrong in."""
    assert _server is not None, "not in a worker process"
    _server.close()


def _picklable(error: Exception) -> Exception:
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:  # simulators and drivers raise types of their own, which may not even pickle
        return RuntimeError(f"{type(error).__name__}: {error}")


class JobPool:
    """Worker processes for jobs; started as jobs come, at most as many as said.

    Args:
        platform: of the simulators; empty where no job asks for one.
        options: of the simulators, JSON values.
        workers: processes; 0 takes one, on a cluster as many as it has CPUs.
        limit_s: longest that one job may take; None waits for ever.
        fresh: each job has a process of its own; its start counts.
        workplace: where they live. A cluster is joined for the first job.
    """

    def __init__(
        self,
        platform: str = "",
        options: Mapping[str, Any] | None = None,
        workers: int = 1,
        *,
        limit_s: float | None = None,
        fresh: bool = False,
        workplace: Backend = LOCAL,
    ):
        self.platform, self.options = platform, dict(options or {})
        self._asked, self._fresh, self._workplace = workers, fresh, workplace
        self._settled = 0
        self._pool = SlotPool(
            SlotConfig(platform, self.options, server=SERVER, start_s=0.0 if fresh else None),
            workers=True,
            timeout_s=math.inf if limit_s is None else limit_s,
        )

    def __enter__(self) -> JobPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.close()

    def outcomes[I](
        self, work: Callable[..., Any], items: Iterable[I], arguments: Callable[[I], tuple]
    ) -> Iterator[tuple[I, Outcome]]:
        """Runs `work(*arguments(item))` for every item, and yields what became of each as it comes.

        Args:
            work: a function of a module.
            items: drawn as there is room, so that they never have to fit into memory.
            arguments: of one item, picklable.
        """
        name = _name_of(work)
        drawn = iter(items)
        first = list(islice(drawn, 1))
        first += islice(drawn, self._most() - 1 if first else 0)
        waiting = chain(first, drawn)

        def take(_last: list[I] | None, _busy: list[list[I]]) -> list[I] | None:
            return next(([item] for item in waiting), None)

        for (item,), reply in map_unordered(
            self._slots(len(first)), "run", take, lambda one: Job(name, arguments(one[0])), fresh=self._fresh
        ):
            yield item, reply

    def run[I](
        self,
        work: Callable[..., Any],
        items: Iterable[I],
        arguments: Callable[[I], tuple] = lambda item: (item,),
    ) -> Iterator[tuple[I, Any]]:
        """The items with their results, as they come.

        Raises:
            SimulatorError: a process died or hung.
            Exception: what a job raised.
        """
        for item, outcome in self.outcomes(work, items, arguments):
            yield item, _value(outcome)

    def map_ordered[I](
        self,
        work: Callable[..., Any],
        items: Sequence[I],
        arguments: Callable[[I], tuple] = lambda item: (item,),
    ) -> Iterator[Any]:
        """The results in the order of the items, with few of them ahead of the caller: see `run`."""
        name, slots = _name_of(work), self._slots(min(self._most(), len(items)) if items else 0)
        for outcome in map_ordered(slots, "run", items, lambda item: Job(name, arguments(item))):
            yield _value(outcome)

    def call(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Runs `work` in a process that has imported by now what jobs before it needed: see `run`."""
        ((_, value),) = self.run(work, [arguments], lambda them: them)
        return value

    def _most(self) -> int:
        """How many processes there may be."""
        self._settled = self._settled or self._workplace.allocate_workers(self._pool, self._asked, 1)
        return self._settled

    def _slots(self, count: int) -> list[SimulatorWorker]:
        return self._pool.worker_slots(count)


def _value(outcome: Outcome) -> Any:
    if isinstance(outcome, JobError):
        raise outcome.error
    if isinstance(outcome, SlotFailure):
        raise SimulatorError(
            "a worker process died (out of memory, or a crash in native code) or hung. What it had finished "
            "is kept: run the command again, with fewer workers if memory was short. It said: "
            f"{outcome.message}"
        )
    return outcome.value


def _name_of(work: Callable[..., Any]) -> str:
    """`module:function`, as a worker finds it: the program that was started is no `__main__` there."""
    module, name = work.__module__, getattr(work, "__qualname__", repr(work))
    if module == "__main__":
        spec = getattr(sys.modules["__main__"], "__spec__", None)
        module = spec.name if spec is not None else module
    if "." in name or module == "__main__":
        raise ValueError(f"{module}:{name} is no function of a module that a worker can import")
    return f"{module}:{name}"
