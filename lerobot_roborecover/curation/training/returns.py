"""Returns, values and advantages of training frames, in RECAP's manner.

RECAP (pi*0.6) trains a policy on how much better than expected an action turned out, with a reward of -1 a
step, and a large loss where an episode fails. Here, with S the task's horizon and n the steps that an episode
still takes to its success:

    return to go   R_t = -n / S where the episode succeeds, -1 where it fails      (from -1 to 0)
    value          V_t = mean of R over frames of other episodes in a state like this one
    advantage      A_t = R_t - V_t

States are alike that are of one task and of the same tenth of its progress; where progress is not known, of
the same tenth of the horizon. Episodes of the same scenario and trial (forks of one trial) do not speak for
each other. Where no other episode has such a frame, V is the mean over the task's other episodes, and, where
there are none, R itself: the advantage is then 0.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from lerobot_roborecover.curation.training.lines import TrainingLine

BINS = 10


def returns_to_go(line: TrainingLine) -> np.ndarray:
    """(steps,) R of the episode's frames."""
    if not line.success:
        return np.full(line.steps, -1.0)
    left = np.arange(line.steps, 0, -1)
    return -np.minimum(left / line.scenario.task.horizon, 1.0)


def values(lines: Sequence[TrainingLine]) -> list[np.ndarray]:
    """V of every episode's frames, (steps,) each."""
    returns = [returns_to_go(line) for line in lines]
    bins = [_bins(line) for line in lines]
    sums: dict[tuple, np.ndarray] = defaultdict(lambda: np.zeros(2))
    own: dict[tuple, np.ndarray] = defaultdict(lambda: np.zeros(2))
    for line, found, where in zip(lines, returns, bins, strict=True):
        for value, key in zip(found, where, strict=True):
            for level in (key, key[:2]):
                sums[level] += (value, 1)
                own[level, _group(line)] += (value, 1)
    told = []
    for line, found, where in zip(lines, returns, bins, strict=True):
        told.append(np.array([_value(sums, own, line, key, r) for key, r in zip(where, found, strict=True)]))
    return told


def _value(sums: dict, own: dict, line: TrainingLine, key: tuple, fallback: float) -> float:
    for level in (key, key[:2]):
        total, count = sums[level] - own[level, _group(line)]
        if count > 0.5:
            return float(total / count)
    return float(fallback)


def _group(line: TrainingLine) -> tuple:
    return line.scenario.id, line.trial


def _bins(line: TrainingLine) -> list[tuple]:
    task = line.scenario.task
    steps = np.arange(line.first, len(line.actions))
    if line.progress is None:
        kind, share = "step", steps / task.horizon
    else:
        kind, share = "progress", line.progress[line.first :]
    tenths = np.minimum((share * BINS).astype(int), BINS - 1)
    return [(task.suite, task.name, kind, int(tenth)) for tenth in tenths]
