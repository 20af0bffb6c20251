"""Runs each job in a process of its own, so that one which crashes or hangs is only its own end."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from lerobot_roborecover.env.parent import end_with_parent


@dataclass(frozen=True)
class Crash:
    """Why a job has no result."""

    reason: str


def run_isolated[J](
    work: Callable[[J], Any], jobs: Iterable[J], workers: int, limit_s: float
) -> Iterator[tuple[J, Any]]:
    """Results as jobs finish; a fresh process for each.

    Args:
        work: a function of a module; what it raises becomes a `Crash`, too.
        jobs: picklable; drawn as there is room, so that they never have to fit into memory.
        workers: processes at once.
        limit_s: longest that one may take, its start included.

    Yields:
        A job, and what `work` returned, or a `Crash`.
    """
    # Spawned, because OpenGL contexts and threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    waiting, more = iter(jobs), True
    running: dict[Connection, tuple[Any, J, float]] = {}
    try:
        while more or running:
            while more and len(running) < max(workers, 1):
                try:
                    job = next(waiting)
                except StopIteration:
                    more = False
                    break
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_child, args=(theirs, work, job, os.getpid()))
                process.start()
                theirs.close()
                running[ours] = (process, job, time.monotonic() + limit_s)
            if not running:
                break
            first = min(deadline for *_, deadline in running.values())
            for ready in wait(list(running), timeout=max(first - time.monotonic(), 0.0)):
                assert isinstance(ready, Connection)
                process, job, _ = running.pop(ready)
                yield job, _result(ready, process)
            for late in [c for c, (*_, deadline) in running.items() if deadline <= time.monotonic()]:
                process, job, _ = running.pop(late)
                process.kill()
                process.join()
                late.close()
                yield job, Crash(f"it took more than {limit_s:g} s")
    finally:
        for connection, (process, *_) in running.items():
            process.kill()
            process.join()
            connection.close()


def _result(connection: Connection, process: Any) -> Any:
    try:
        result = connection.recv()
    except (EOFError, OSError):
        result = None
    finally:
        connection.close()
    process.join()
    if result is None:
        return Crash(f"its process ended with status {process.exitcode}")
    return result[0]


def _child(connection: Connection, work: Callable[[Any], Any], job: Any, parent: int) -> None:
    end_with_parent(parent)
    try:
        result = work(job)
    except Exception as err:  # whatever it is must not stop the others
        result = Crash(f"{type(err).__name__}: {err}")
    connection.send((result,))
    connection.close()
