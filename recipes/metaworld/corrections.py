"""Meta-World's side of `recipes.recovery_per_hour`: demonstrations, and corrections by a scripted operator.

The operator is LeRobot's scripted policy of the task; where one attempt of it fails, the patient one, which
backs off and tries again. What it does is recorded, and kept if it solves the task.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from lerobot_roborecover.platforms.metaworld.experts import expert, patient_expert
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.scenario import Reset, Task
from recipes.corrections import drive_on
from recipes.episodes import Episode, read_episodes
from recipes.learned import LearnedPolicy
from recipes.metaworld.dataset import record
from recipes.metaworld.study_policies import make_demonstrations

FIRST_SEED = 60_000
"""Seeds of the rollouts that are taken over start here; scenarios and demonstrations use smaller ones."""
TAKEN_OVER = (10, 120)
"""Steps that the policy has driven when the operator takes over: from, and below."""
_ATTEMPT, _ATTEMPTS = 150, 220
"""Steps of the operator: in one attempt, and with a second one."""


def correction(simulator: MetaworldSimulator, task: Task, seed: int) -> Episode | None:
    """What the operator does from here, until the task is solved; None where it is not.

    Args:
        simulator: in mid-rollout; it is left elsewhere.
        task: of the rollout.
        seed: of the patient operator's jitter.
    """
    here = simulator.snapshot()
    made = record(simulator, task, expert(simulator, task.name), _ATTEMPT)
    if made is None:
        simulator.restore(here)
        patient = patient_expert(simulator, task.name, np.random.default_rng(seed))
        made = record(simulator, task, patient, _ATTEMPTS)
    return made


def demonstrations(out: Path, base: str) -> list[Episode]:
    """Those that a policy has learned from, made if they are not there.

    Args:
        out: folder to work in.
        base: its name: `act`, which has learned from all.
    """
    if base != "act":
        raise ValueError(f"{base} has learned from some of the demonstrations; only those of act are known")
    make_demonstrations(out)
    return read_episodes(out / "demonstrations")


def takeovers(base: Path, tasks: Iterable[Task], frames: int) -> Iterator[Episode]:
    """From a drawn step of the policy's own rollouts, of each task as many as it takes.

    Args:
        base: checkpoint of the policy.
        tasks: of which.
        frames: of each task, at least.
    """
    simulator = MetaworldSimulator(obs_type="state")
    for task in tasks:
        made, seed = 0, FIRST_SEED
        drive = LearnedPolicy(simulator, task, str(base))
        while made < frames:
            seed += 1
            steps = int(np.random.default_rng(seed).integers(*TAKEN_OVER))
            simulator.reset(task, Reset(seed=seed))
            drive.reset()
            if drive_on(simulator, drive, steps) and (found := correction(simulator, task, seed)):
                made += len(found)
                yield found
    simulator.close()
