"""The one protocol behind every platform, and the one loop that steps a simulator through known actions.

Everything above the platforms knows only the protocol. All replays use the loop:

    for step in iter_steps(simulator, rollout):
        if step in wanted:
            seen.append(simulator.observe())

Between two steps the simulator is in the state after `step` actions. There the caller reads what it needs:
observation, image, poses, predicate, hash. Nothing is rendered unless the caller asks for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.scenario import Pose, Reset, Rollout, Task

type Observation = dict[str, Any]
"""LeRobot's raw observation of the platform: nested dicts of arrays, before any processor."""

HANDLE, GOAL, GOAL_OF = ".handle", "goal", ".goal"
"""Names of marks among the bodies, or their endings; see `Simulator.bodies`."""


def is_mark(name: str) -> bool:
    """Whether what `Simulator.bodies` names is a mark, and nothing that moves by itself."""
    return name == GOAL or name.endswith((HANDLE, GOAL_OF))


class SimulatorError(RoboRecoverError, RuntimeError):
    """The simulator cannot do what was asked; the message says what, why and the remedy."""


class Simulator(Protocol):
    """A task simulator whose resets and replays are exact.

    Constructed with keyword options that are plain JSON values, so that they can travel to a worker process.
    A simulator is never shared between threads or processes, and imports neither LeRobot nor torch if it can
    help it.
    """

    platform: str
    control_hz: float
    action_dim: int
    observation_space: gym.spaces.Dict
    snapshot_is_exact: bool
    """A restored snapshot continues bit-identically to a replay."""

    def reset(self, task: Task, reset: Reset) -> None:
        """Puts the task in its exact first state; rebuilds the model only when the task's model changes."""

    def step(self, action: np.ndarray) -> None:
        """Advances one control step; renders nothing, and is bit-identical to a step that renders.

        Args:
            action: (action_dim,), float64 or float32 exactly as recorded or as the policy gave it; never
                clipped here.
        """

    def observe(self) -> Observation:
        """The observation after the last step or reset, as LeRobot's own env of the platform gives it."""

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8 upright picture of the scene for people, of the last step or reset."""

    def succeeded(self) -> bool:
        """The task's own success predicate, nothing else."""

    def bodies(self) -> dict[str, Pose]:
        """World poses; names that start with `eef` are end effectors, the rest whatever else can move.

        A platform may add marks without a direction of their own: `<body>` + `HANDLE`, the point of a body
        that the task is about, and `GOAL`, where the task wants that point; or, where it has several places
        to bring something to, `<body>` + `GOAL_OF` for each body, where the task wants it.
        """

    def state_sha256(self) -> str:
        """SHA-256 of the complete integration state."""

    def snapshot(self) -> bytes:
        """The complete state, to be restored on a simulator that was reset to the same task and reset."""

    def restore(self, snapshot: bytes) -> None:
        """Puts a snapshot back. Where snapshots are exact, observations are valid only after a further
        `step`."""

    def fixtures(self) -> Mapping[str, Pose]:
        """Fixture poses of the current reset that a scenario's `Reset` must carry; empty where there are
        none."""

    def fingerprint(self) -> dict[str, str]:
        """Package and asset versions that decide the physics, and the robot (`robot_fingerprint`) where the
        user brings its files."""

    def close(self) -> None:
        """Frees the simulator; further calls are undefined."""


@runtime_checkable
class ShowsProgress(Protocol):
    """Optional protocol of a simulator that reports a task's progress, not just its success."""

    def progress(self) -> float:
        """How much of the task is done after the last step or reset: 0 to 1, and 1 just where `succeeded`.

        Asked after every step of a trial, so it has to be cheap; it changes nothing in the simulation.
        """


@runtime_checkable
class ControlModes(Protocol):
    """Optional protocol of a simulator that reads actions in more than one way."""

    def set_control_mode(self, mode: str) -> None:
        """Reads actions so from now on, until the next reset."""


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
