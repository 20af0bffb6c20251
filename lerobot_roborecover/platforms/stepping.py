"""Steps a simulator through known actions. All replays use this loop.

    for step in iter_steps(simulator, rollout):
        if step in wanted:
            seen.append(simulator.observe())

Between two steps the simulator is in the state after `step` actions. There the caller reads what it needs:
observation, image, poses, predicate, hash. Nothing is rendered unless the caller asks for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np

from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.scenario import Rollout


class Steppable(Protocol):
    """A simulator, or a wrapper of a simulator."""

    def step(self, action: np.ndarray) -> None:
        """Advances one control step."""


def iter_steps(simulator: Simulator, rollout: Rollout, steps: int | None = None) -> Iterator[int]:
    """Resets a rollout's task and replays its actions.

    Args:
        simulator: left after the last action that was asked for.
        rollout: what to replay.
        steps: so many of its actions; None for all.

    Yields:
        The number of actions executed so far: 0 after the reset, and the next one after each action.
    """
    simulator.reset(rollout.task, rollout.reset)
    yield from follow(simulator, rollout.actions[:steps])


def follow(simulator: Steppable, actions: Iterable[np.ndarray], first: int = 0) -> Iterator[int]:
    """Executes actions from wherever the simulator stands.

    Args:
        simulator: left after the last action that was asked for.
        actions: (A,) each.
        first: number of the state where it stands.

    Yields:
        `first`, and the next number after each action.
    """
    yield first
    for step, action in enumerate(actions, first + 1):
        simulator.step(action)
        yield step


def advance(simulator: Steppable, actions: Iterable[np.ndarray]) -> None:
    """Executes actions without looking in between."""
    for _ in follow(simulator, actions):
        pass
