"""Rollouts of controllers that read the simulator's own state, and the paper's perturbation of actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.replay.recorder import PERTURBED, UNPERTURBED, Recorder
from lerobot_roborecover.scenario import Reset, Task

PERTURBED_STEPS = 150
"""Interaction steps in which actions are perturbed (paper, "Action-Perturbed Scenarios")."""


def perturb_translations(
    action: np.ndarray, rng: np.random.Generator, reach: Sequence[float] = (1.0, 1.0, 1.0)
) -> np.ndarray:
    """Adds independent Uniform(-1, 1) to the three translations, in normalised action space (paper, eq. 1).

    Args:
        action: (A,).
        rng: draws.
        reach: half-widths by leading value, where a platform's actions are no normalised translations
            (`Platform.perturbation`).
    """
    action = np.array(action, dtype=np.float64)
    noise = rng.uniform(-1.0, 1.0, len(reach)) * reach
    disturbed = min(len(action), len(reach))  # two in a plane
    action[:disturbed] += noise[:disturbed]
    return action


def record(
    simulator: Simulator,
    task: Task,
    reset: Reset,
    act: Callable[[int], np.ndarray],
    *,
    steps: int,
    settle_action: np.ndarray | None = None,
    perturb: np.random.Generator | None = None,
    perturbed_steps: int = PERTURBED_STEPS,
    stop_when_solved: bool = True,
) -> Recorder:
    """Drives a task from its reset and records it exactly.

    Args:
        simulator: reset here.
        task: what to drive.
        reset: its `settle_steps` are filled with `settle_action`.
        act: next action for the given step (settling excluded), read from the simulator's own state.
        steps: most actions after settling.
        settle_action: (A,) action repeated while settling.
        perturb: source of the paper's action perturbation; None leaves the actions alone.
        perturbed_steps: how many leading steps are perturbed.
        stop_when_solved: end at the first state where the predicate holds.

    Returns:
        The recorder: `rollout` for replay, `steps` for what happened.
    """
    recorder = Recorder(simulator)
    recorder.reset(task, reset)
    for _ in range(reset.settle_steps):
        if settle_action is None:
            raise ValueError(
                f"reset asks for {reset.settle_steps} settling steps, but no settle_action was given"
            )
        recorder.step(settle_action)
    for t in range(steps):
        action = np.asarray(act(t), dtype=np.float64)
        if perturb is not None and t < perturbed_steps:
            recorder.step(perturb_translations(action, perturb), PERTURBED)
        else:
            recorder.step(action, UNPERTURBED)
        if stop_when_solved and recorder.solved[-1]:
            break
    return recorder
