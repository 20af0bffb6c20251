"""Controllers for Meta-World: its own scripted policies, degraded and patient variants."""

from __future__ import annotations

import warnings

import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from metaworld.policies.policy import Policy

from lerobot_roborecover.platforms.base import Controller
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator

_REST_POSITION_M = np.array([0.0, 0.6, 0.25])
"""Where the patient controller goes between attempts: above the middle of the table."""
_OBJECT_XY = slice(4, 6)
"""Horizontal position of the first object in Meta-World's observation."""


def expert(simulator: MetaworldSimulator, task_name: str) -> Controller:
    """Meta-World's scripted policy of a task: memoryless, right about where everything is, and brittle.

    Its commands are proportional to the remaining error and leave [-1, 1]; they are clipped, as the simulator
    would do itself, so that a perturbation on top means what it means for a learned policy.
    """
    policy = ENV_POLICY_MAP[task_name]()

    def act(_t: int) -> np.ndarray:
        return _clipped(policy, simulator.low_dim())

    return act


def patient_expert(
    simulator: MetaworldSimulator,
    task_name: str,
    rng: np.random.Generator,
    patience_steps: int = 130,
    back_off_steps: int = 45,
    jitter_m: float = 0.012,
) -> Controller:
    """The scripted policy with retries: proof that a state can be recovered where one attempt gets stuck.

    It opens the gripper, rises and returns to the middle, then attempts the task for `patience_steps`; from
    the second attempt on, it believes the object to be up to `jitter_m` from where it is, which frees it from
    a grasp that fails the same way each time.

    Args:
        simulator: reset and handed over already.
        task_name: whose scripted policy.
        rng: draws the jitter.
        patience_steps: steps an attempt may take.
        back_off_steps: steps between attempts, and before the first.
        jitter_m: largest deliberate error of the object's position along x and y.
    """
    policy = ENV_POLICY_MAP[task_name]()
    cycle = patience_steps + back_off_steps
    offset = np.zeros(2)

    def act(t: int) -> np.ndarray:
        nonlocal offset
        phase = t % cycle
        raw = simulator.low_dim()
        if phase < back_off_steps:
            if phase == 0 and t > 0:
                offset = rng.uniform(-jitter_m, jitter_m, 2)
            rising = phase < back_off_steps // 2
            goal = np.array([*raw[:2], _REST_POSITION_M[2]]) if rising else _REST_POSITION_M
            return np.clip(np.array([*(10.0 * (goal - raw[:3])), -1.0]), -1.0, 1.0)
        raw[_OBJECT_XY] += offset
        return _clipped(policy, raw)

    return act


def biased_expert(simulator: MetaworldSimulator, task_name: str, rng: np.random.Generator) -> Controller:
    """The scripted policy with a camera out of calibration: it sees the object 1.5 to 4.5 cm off."""
    policy = ENV_POLICY_MAP[task_name]()
    angle, distance_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.015, 0.045)
    error = distance_m * np.array([np.cos(angle), np.sin(angle)])

    def act(_t: int) -> np.ndarray:
        raw = simulator.low_dim()
        raw[_OBJECT_XY] += error
        return _clipped(policy, raw)

    return act


def weak_grip_expert(simulator: MetaworldSimulator, task_name: str, rng: np.random.Generator) -> Controller:
    """The scripted policy with a tired gripper: it closes with 3 to 30 % of the force, and things slip."""
    policy = ENV_POLICY_MAP[task_name]()
    strength = rng.uniform(0.03, 0.3)

    def act(_t: int) -> np.ndarray:
        action = _clipped(policy, simulator.low_dim())
        action[3] = min(action[3], strength)
        return action

    return act


def _clipped(policy: Policy, raw: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "Constant(s) may be too high": about the clipping done here
        action = policy.get_action(raw)
    return np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
