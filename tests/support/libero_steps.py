"""Tasks, actions and comparisons for tests of LIBERO's simulator."""

from __future__ import annotations

import numpy as np

from lerobot_roborecover.platforms.libero.catalog import (
    LIBERO_HORIZONS,
    libero_instruction,
    libero_tasks,
)
from lerobot_roborecover.scenario import Task

STEPS = 40


def task_of(suite: str, index: int) -> Task:
    name = libero_tasks()[suite][index]
    return Task("libero", suite, name, libero_instruction(name), LIBERO_HORIZONS[suite])


def actions(steps: int = STEPS, seed: int = 0) -> np.ndarray:
    """(steps, 7) pushes into table and objects, beyond the limits that robosuite clips at."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(-1.5, 1.5, (steps, 7))
    a[:, 2] -= 0.6
    a[::2, 3:6] = 0.0
    a[:, 6] = np.where(np.arange(steps) % 20 < 10, 1.0, -1.0)
    return a


def clock_of(env) -> np.ndarray:
    """The sampling clock of robosuite's observables."""
    observable = env._observables["robot0_eef_pos"]
    return np.array([observable._time_since_last_sample, float(observable._sampled)])


def assert_robot_state_equals(ours: dict, theirs: dict) -> None:
    for group, keys in {
        "eef": ("pos", "quat", "mat"),
        "gripper": ("qpos", "qvel"),
        "joints": ("pos", "vel"),
    }.items():
        for key in keys:
            a, b = ours[group][key], theirs[group][key]
            assert (a.dtype, a.shape) == (b.dtype, b.shape), f"{group}.{key}"
            assert np.array_equal(a, b), f"{group}.{key}: {a - b}"
