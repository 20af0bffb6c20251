"""Replays trajectories and looks only where asked, in as many processes as wanted.

Imports neither LeRobot nor torch, so that a process starts in a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import Observation, Simulator, make_simulator
from lerobot_roborecover.platforms.simulator import ShowsProgress, follow
from lerobot_roborecover.replay.handoff import SnapshotCache, replay_to
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker

GROUPED_LOOKS = 512
"""Observations of jobs that one process replays together, at most: all are in memory at once."""


@dataclass(frozen=True)
class RenderJob:
    """A trajectory, and the steps to look at."""

    scenario: Scenario
    actions: np.ndarray
    """(n, A) after the prefix."""
    steps: np.ndarray
    """(k,) increasing, of the prefix and the actions together."""
    prefix_steps: int | None = None
    """So many actions of the prefix come first, where a trial began before the recovery point; None: all."""


@dataclass(frozen=True)
class RenderedSteps:
    """What was seen."""

    observations: list[Observation]
    """Before each of the steps."""
    succeeded: bool
    """The predicate after the last action."""
    progress: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(k,) of the task before each of the steps; NaN where the simulator does not tell."""


def render_steps(simulator: Simulator, jobs: Sequence[RenderJob]) -> list[RenderedSteps]:
    """Replays trajectories to their ends; renders only what is asked for.

    Args:
        simulator: which.
        jobs: with one scenario and as many steps of its prefix, which is replayed once where the simulator's
            snapshots are exact.
    """
    scenario, length = jobs[0].scenario, len(jobs[0].scenario.prefix[: jobs[0].prefix_steps])
    cache = SnapshotCache() if len(jobs) > 1 else None
    wanted = {step for job in jobs for step in job.steps.tolist()}
    shared: dict[int, tuple[Observation, float]] = {}

    def in_prefix(step: int) -> None:
        if step in wanted:
            shared[step] = _look(simulator)

    found = []
    for job in jobs:
        asked = set(job.steps.tolist())
        replay_to(simulator, scenario.rollout, length, cache, in_prefix)
        # Each action in its own type: the prefix in float64, these as the policy gave them.
        own = {s: _look(simulator) for s in follow(simulator, job.actions, length) if s in asked}
        looks = [look for step, look in sorted((shared | own).items()) if step in asked]
        progress = np.array([p for _, p in looks], float)
        found.append(RenderedSteps([o for o, _ in looks], simulator.succeeded(), progress))
    return found


def _look(simulator: Simulator) -> tuple[Observation, float]:
    return simulator.observe(), simulator.progress() if isinstance(simulator, ShowsProgress) else np.nan


def groups(jobs: Iterable[RenderJob]) -> Iterator[list[RenderJob]]:
    """Puts jobs that follow each other and have one prefix together, up to `GROUPED_LOOKS` observations."""
    group: list[RenderJob] = []
    looks = 0
    for job in jobs:
        same = group and group[0].scenario is job.scenario and group[0].prefix_steps == job.prefix_steps
        if group and not (same and looks + len(job.steps) <= GROUPED_LOOKS):
            yield group
            group, looks = [], 0
        group.append(job)
        looks += len(job.steps)
    if group:
        yield group


def replayed(jobs: Sequence[RenderJob], options: Mapping[str, Any], workers: int) -> Iterator[RenderedSteps]:
    """Yields what each job renders, in their order.

    Args:
        jobs: of one platform.
        options: of the simulator.
        workers: processes; 1 replays in this one.
    """
    platform = jobs[0].scenario.platform
    if workers <= 1:
        simulator = make_simulator(platform, **options)
        try:
            for group in groups(jobs):
                yield from render_steps(simulator, group)
        finally:
            simulator.close()
        return
    with JobPool(platform, options, workers) as pool:
        yield from chain.from_iterable(pool.map_ordered(_render_steps, list(groups(jobs)), tuple))


def _render_steps(*group: RenderJob) -> list[RenderedSteps]:
    return render_steps(simulator_of_worker(), group)
