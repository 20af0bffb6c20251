"""Replays trajectories and looks only where asked, in as many processes as wanted.

Imports neither LeRobot nor torch, so that a process starts in a second.
"""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.simulators import Observation, Simulator, make_simulator


@dataclass(frozen=True)
class Job:
    """A trajectory, and the steps to look at."""

    scenario: Scenario
    actions: np.ndarray
    """(n, A) after the prefix."""
    steps: np.ndarray
    """(k,) increasing, of the prefix and the actions together."""


@dataclass(frozen=True)
class Film:
    """What was seen."""

    observations: list[Observation]
    """Before each of the steps."""
    succeeded: bool
    """The predicate after the last action."""


def film(simulator: Simulator, job: Job) -> Film:
    """Replays one trajectory to its end; renders only what is asked for."""
    wanted = set(job.steps.tolist())
    simulator.reset(job.scenario.task, job.scenario.reset)
    seen = []
    t = len(job.scenario.prefix)
    for step in range(t + len(job.actions)):
        if step in wanted:
            seen.append(simulator.observe())
        simulator.step(job.scenario.prefix[step] if step < t else job.actions[step - t])
    return Film(seen, simulator.succeeded())


def replayed(jobs: Sequence[Job], options: Mapping[str, Any], workers: int) -> Iterator[Film]:
    """Films of the jobs, in their order.

    Args:
        jobs: of one platform.
        options: of the simulator.
        workers: processes; 1 replays in this one.
    """
    platform = jobs[0].scenario.platform
    if workers <= 1:
        simulator = make_simulator(platform, **options)
        try:
            yield from (film(simulator, job) for job in jobs)
        finally:
            simulator.close()
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_open, initargs=(platform, dict(options))) as pool:
        waiting: deque = deque()
        for job in jobs:
            waiting.append(pool.submit(_film, job))
            if len(waiting) > 2 * workers:  # films are large: only a few ahead of the writer
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


_simulator: Simulator | None = None


def _open(platform: str, options: dict[str, Any]) -> None:
    global _simulator
    _simulator = make_simulator(platform, **options)


def _film(job: Job) -> Film:
    assert _simulator is not None
    return film(_simulator, job)
