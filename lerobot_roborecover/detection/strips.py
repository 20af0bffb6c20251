"""Pictures of trials, for the frame strips of the page; rendered in worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from lerobot_roborecover.analysis.figures.detection import FrameStrip
from lerobot_roborecover.detection.trials import ReplayedTrial
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.simulator import follow
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.workers.jobs import Done, JobError, JobPool, simulator_of_worker

SIZE = 128
"""Width and height of a frame, pixels."""
FRAMES = 8
"""Of a strip."""
_TIMEOUT_S = 300.0


def choose_trials(trials: Sequence[ReplayedTrial], count: int) -> list[int]:
    """Numbers of trials worth looking at: by turns one that fails from its recovery point, one that recovers
    by itself, and one clean success; each kind in the order of the scenarios."""
    kinds = [
        [i for i, t in enumerate(trials) if t.row.start == "recovery" and not t.row.success],
        [i for i, t in enumerate(trials) if t.row.start == "recovery" and t.row.success],
        [i for i, t in enumerate(trials) if t.row.start == "initial" and t.row.success],
    ]
    turns = [kind[n] for n in range(count) for kind in kinds if n < len(kind)]
    return turns[:count]


def frame_strips(trials: Sequence[ReplayedTrial], chosen: Sequence[int]) -> tuple[list[FrameStrip], str]:
    """Strips of the chosen trials; without pictures where they cannot be rendered, and why.

    Args:
        trials: all of them.
        chosen: numbers of those shown.
    """
    if not chosen:
        return [], ""
    problem = ""
    strips: dict[int, FrameStrip] = {}
    options = platform_named(trials[chosen[0]].scenario.platform).picture_options(SIZE)
    with JobPool(trials[chosen[0]].scenario.platform, options, 1, limit_s=_TIMEOUT_S) as pool:
        outcomes = pool.outcomes(_pictures, list(chosen), lambda i: _arguments(trials[i]))
        for number, outcome in outcomes:
            pictures: list[np.ndarray] = []
            if isinstance(outcome, Done):
                pictures = outcome.value
            elif not problem:
                why = outcome.words if isinstance(outcome, JobError) else outcome.message
                problem = f"{trials[number].scenario.id}: {why}"
            strips[number] = FrameStrip(number, _steps(trials[number]), tuple(pictures))
    return [strips.get(i, FrameStrip(i, _steps(trials[i]), ())) for i in chosen], problem


def _steps(trial: ReplayedTrial) -> tuple[int, ...]:
    """Steps of the frames, from a little before the handoff to the end."""
    last = trial.handoff + len(trial.actions) - 1
    first = max(trial.handoff - (last - trial.handoff) // FRAMES, 0)
    return tuple(int(s) for s in np.linspace(first, last, min(FRAMES, last - first + 1)).round())


def _arguments(trial: ReplayedTrial) -> tuple[Scenario, int, np.ndarray, tuple[int, ...]]:
    return trial.scenario, trial.handoff, trial.actions, _steps(trial)


def _pictures(
    scenario: Scenario, handoff: int, actions: np.ndarray, steps: Sequence[int]
) -> list[np.ndarray]:
    """(H, W, 3) uint8 pictures before the steps; runs in a worker process."""
    simulator = simulator_of_worker()
    simulator.reset(scenario.task, scenario.reset)
    seen = []
    for step in follow(simulator, chain(scenario.prefix[:handoff], actions)):
        if step in steps:
            seen.append(np.asarray(simulator.render()))
        if step >= steps[-1]:
            break
    return seen
