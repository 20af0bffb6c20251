"""Rollouts recorded step by step: exact actions, body poses, success, and where a perturbation was
applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lerobot_roborecover.scenario import Pose, Reset, Task
from lerobot_roborecover.simulators.base import Simulator

PERTURBED_STEPS = 150
"""Interaction steps in which actions are perturbed (paper, "Action-Perturbed Scenarios")."""


@dataclass
class Rollout:
    """One recorded trajectory of T actions and T + 1 states."""

    task: Task
    reset: Reset
    driver: str
    """Name of the policy or expert that drove."""
    actions: list[np.ndarray] = field(default_factory=list)
    """T executed actions, (A,) float64."""
    bodies: list[dict[str, Pose]] = field(default_factory=list)
    """T + 1 body poses, before the first action and after each."""
    solved: list[bool] = field(default_factory=list)
    """T + 1 values of the task's predicate."""
    perturbed: list[bool] = field(default_factory=list)
    """T flags: the action was perturbed."""

    @property
    def prefix(self) -> np.ndarray:
        """(T, A) float64 actions."""
        return np.array(self.actions, dtype=np.float64)

    def positions(self, body: str) -> np.ndarray:
        """(T + 1, 3) float64 metres of one body."""
        return np.array([b[body].position_m for b in self.bodies])


def perturb_translations(action: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds independent Uniform(-1, 1) to the three translations, in normalised action space (paper, eq.
    1)."""
    action = np.array(action, dtype=np.float64)
    noise = rng.uniform(-1.0, 1.0, 3)
    translations = min(len(action), 3)  # two in a plane
    action[:translations] += noise[:translations]
    return action


def record(
    simulator: Simulator,
    task: Task,
    reset: Reset,
    act: Callable[[int], np.ndarray],
    *,
    steps: int,
    driver: str,
    settle_action: np.ndarray | None = None,
    perturb: np.random.Generator | None = None,
    perturbed_steps: int = PERTURBED_STEPS,
    stop_when_solved: bool = True,
) -> Rollout:
    """Drives a task from its reset and records it exactly.

    Args:
        simulator: reset here.
        task: what to drive.
        reset: its `settle_steps` are filled with `settle_action`.
        act: next action for the given step (settling excluded), read from the simulator's own state.
        steps: most actions after settling.
        driver: recorded name of whoever drives.
        settle_action: (A,) action repeated while settling.
        perturb: source of the paper's action perturbation; None leaves the actions alone.
        perturbed_steps: how many leading steps are perturbed.
        stop_when_solved: end at the first state where the predicate holds.
    """
    rollout = Rollout(task, reset, driver)
    simulator.reset(task, reset)
    rollout.bodies.append(simulator.bodies())
    rollout.solved.append(simulator.succeeded())

    def advance(action: np.ndarray, perturbed: bool) -> None:
        action = np.array(action, dtype=np.float64)
        simulator.step(action)
        rollout.actions.append(action)
        rollout.perturbed.append(perturbed)
        rollout.bodies.append(simulator.bodies())
        rollout.solved.append(simulator.succeeded())

    for _ in range(reset.settle_steps):
        if settle_action is None:
            raise ValueError(
                f"reset asks for {reset.settle_steps} settling steps, but no settle_action was given"
            )
        advance(settle_action, False)
    for t in range(steps):
        action = np.asarray(act(t), dtype=np.float64)
        noisy = perturb is not None and t < perturbed_steps
        advance(perturb_translations(action, perturb) if noisy else action, noisy)
        if stop_when_solved and rollout.solved[-1]:
            break
    return rollout
