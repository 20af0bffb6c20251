"""Replays trajectories and looks only where asked, in as many processes as wanted.

Imports neither LeRobot nor torch, so that a process starts in a second.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from lerobot_roborecover.platforms import Observation, Simulator, make_simulator
from lerobot_roborecover.platforms.simulator import ShowsProgress, follow
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker


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


def render_steps(simulator: Simulator, job: RenderJob) -> RenderedSteps:
    """Replays one trajectory to its end; renders only what is asked for."""
    wanted = set(job.steps.tolist())
    simulator.reset(job.scenario.task, job.scenario.reset)
    seen, progress = [], []
    # Each action in its own type: the prefix in float64, the others as the policy gave them.
    for step in follow(simulator, chain(job.scenario.prefix[: job.prefix_steps], job.actions)):
        if step in wanted:
            seen.append(simulator.observe())
            progress.append(simulator.progress() if isinstance(simulator, ShowsProgress) else np.nan)
    return RenderedSteps(seen, simulator.succeeded(), np.array(progress, float))


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
            yield from (render_steps(simulator, job) for job in jobs)
        finally:
            simulator.close()
        return
    with JobPool(platform, options, workers) as pool:
        yield from pool.map_ordered(_render_steps, jobs)


def _render_steps(job: RenderJob) -> RenderedSteps:
    return render_steps(simulator_of_worker(), job)
