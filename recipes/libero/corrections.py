"""LIBERO's side of `recipes.recovery_per_hour`: demonstrations, and corrections by the scripted expert."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Task
from recipes.episodes import ACTION, ENVIRONMENT, REWARD, STATE, Episode, read_episodes
from recipes.learned import LearnedPolicy
from recipes.libero.demonstrations import demonstration, expert_episode
from recipes.libero.train import POLICIES, episodes, make_demonstrations

FIRST_SEED = 60_000
"""Seeds of the placements whose rollouts are taken over start here; demonstrations use smaller ones."""
_GIVE_UP_AFTER = 60
"""Rollouts of a task without one more correction."""


def demonstrations(out: Path, base: str) -> list[Episode]:
    """Those that a policy has learned from, made if they are not there.

    Args:
        out: folder to work in.
        base: its name.
    """
    lessons = POLICIES[base]
    make_demonstrations(out, lessons, workers=2)
    made, taken = read_episodes(out / lessons.dataset), episodes(lessons, out / lessons.parts)
    return made if taken is None else [made[n] for n in taken]


def takeovers(base: Path, tasks: Iterable[Task], frames: int) -> Iterator[Episode]:
    """From a drawn step of the policy's own rollouts, of each task as many as it takes, or as there are.

    Args:
        base: checkpoint of the policy.
        tasks: of which.
        frames: of each task, at least.
    """
    simulator = LiberoSimulator(obs_type="state")
    for task in tasks:
        drive = LearnedPolicy(simulator, task, str(base))
        made = lost = 0
        seed = FIRST_SEED
        while made < frames and lost < _GIVE_UP_AFTER:
            seed, lost = seed + 1, lost + 1
            drive.reset()
            try:
                columns = demonstration(simulator, task, seed, perturbed=False, after=drive)
            except SimulatorError:  # LIBERO found no placement
                continue
            if columns is not None:
                episode = _episode(task, columns)
                made, lost = made + len(episode), 0
                yield episode
    simulator.close()


def correction(simulator: LiberoSimulator, task: Task, seed: int = 0) -> Episode | None:
    """What the expert does from here, until the task is solved; None where it is not.

    Args:
        simulator: in mid-rollout; it is left elsewhere.
        task: of the rollout.
        seed: not used: this expert draws nothing.
    """
    columns = expert_episode(simulator, task)
    return None if columns is None else _episode(task, columns)


def _episode(task: Task, columns: dict[str, np.ndarray]) -> Episode:
    return Episode(task.instruction, {name: columns[name] for name in (STATE, ENVIRONMENT, ACTION, REWARD)})
