"""A point mass with a puck and two goals: milliseconds per trial, for tests of everything above a simulator.

The physics is a damped point mass that pushes a puck on contact. Tasks of suite `toy` ask to bring the puck
to the left or to the right goal; tasks of suite `faults` break on purpose at step `FAULT_STEP`, each in its
own way.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import os
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.limits import Workspace
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, ScenarioError, Task

FAULT_STEP = 20
"""Steps after the reset at which a task of suite `faults` breaks."""

FAKE_TASKS: dict[str, dict[str, str]] = {
    "toy": {
        "push-left": "push the puck to the left goal",
        "push-right": "push the puck to the right goal",
    },
    "faults": {
        "raises": "a simulator that raises",
        "exits": "a simulator whose process exits",
        "hangs": "a simulator that hangs",
    },
}
"""Instruction by suite and task name."""

_GOALS = {"push-left": (-0.3, 0.0), "push-right": (0.3, 0.0)}
_GOAL_RADIUS_M = 0.1
_CONTACT_M = 0.08
_DT_S = 0.05


class FakeSimulator:
    """The point-mass simulator.

    Args:
        obs_type: `state` (no pixels) or `pixels_agent_pos`.
        observation_size: side of the square picture, pixels.
        step_s: wall time every step takes, to stand in for a slow simulator.
        cores: a folder and a number: so many of the simulators that name the folder step at once, as if they
            shared that many cores.
    """

    platform = "fake"
    control_hz = 1 / _DT_S
    action_dim = 2
    snapshot_is_exact = True

    def __init__(
        self,
        obs_type: str = "state",
        observation_size: int = 32,
        step_s: float = 0.0,
        cores: tuple[str, int] | None = None,
    ):
        if obs_type not in ("state", "pixels_agent_pos"):
            raise SimulatorError(f"obs_type {obs_type!r} is not 'state' or 'pixels_agent_pos'")
        self._obs_type, self._size, self._step_s = obs_type, observation_size, step_s
        self._locks = [open(Path(cores[0], str(k)), "w") for k in range(cores[1])] if cores else []  # noqa: SIM115
        spaces: dict[str, gym.Space[Any]] = {
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (4,), np.float64),
            "environment_state": gym.spaces.Box(-np.inf, np.inf, (6,), np.float64),
        }
        if obs_type == "pixels_agent_pos":
            side = observation_size
            spaces["pixels"] = gym.spaces.Box(0, 255, (side, side, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(spaces)
        self._state = np.zeros(6)
        self._task: Task | None = None
        self._steps = 0

    def reset(self, task: Task, reset: Reset) -> None:
        """Places mass and puck from the reset's seed."""
        if task.name not in FAKE_TASKS.get(task.suite, {}):
            raise ScenarioError(f"fake has no task {task.suite}/{task.name}")
        self._task, self._steps = task, 0
        rng = np.random.default_rng(reset.seed or 0)
        # Position (2), velocity (2) of the mass, position of the puck (2); metres and metres per second.
        self._state = np.concatenate(
            [rng.uniform(-0.1, 0.1, 2) + np.array([0.0, -0.2]), np.zeros(2), rng.uniform(-0.1, 0.1, 2)]
        )
        self._first_puck = self._state[4:6].copy()

    def step(self, action: np.ndarray) -> None:
        """Drives the mass: `action` (2,) is a velocity command, 1 being 0.6 metres per second, with a
        first-order lag."""
        if self._task is None:
            raise SimulatorError("step before reset")
        if self._step_s:
            with self._core():
                time.sleep(self._step_s)
        self._steps += 1
        if self._task.suite == "faults" and self._steps == FAULT_STEP:
            self._break()
        position, velocity, puck = self._state[:2], self._state[2:4], self._state[4:6]
        velocity = 0.5 * velocity + 0.3 * np.clip(action, -1.0, 1.0)
        position = np.clip(position + velocity * _DT_S, -1.0, 1.0)
        gap = puck - position
        distance = float(np.linalg.norm(gap))
        if 1e-9 < distance < _CONTACT_M:
            puck = position + gap / distance * _CONTACT_M
        self._state = np.concatenate([position, velocity, puck])

    @contextmanager
    def _core(self) -> Generator[None]:
        """Holds one of the cores, where there is a limit."""
        mine = None
        while self._locks and mine is None:
            mine = next((lock for lock in self._locks if _taken(lock)), None)
            if mine is None:
                time.sleep(0.0005)
        try:
            yield
        finally:
            if mine is not None:
                fcntl.flock(mine, fcntl.LOCK_UN)

    def _break(self) -> None:
        assert self._task is not None
        if self._task.name == "raises":
            raise RuntimeError("the fake simulator broke on purpose")
        if self._task.name == "exits":
            os._exit(3)
        while True:  # in native code, with the interpreter's lock held: only a kill ends it
            ctypes.PyDLL(None).sleep(3600)

    def observe(self) -> Observation:
        """State vectors, and a picture where asked for."""
        goal = _GOALS.get(self._task.name, (0.0, 0.0)) if self._task else (0.0, 0.0)
        observation: Observation = {
            "agent_pos": self._state[:4].copy(),
            "environment_state": np.concatenate([self._state[:2], self._state[4:6], goal]),
        }
        if self._obs_type == "pixels_agent_pos":
            observation["pixels"] = self.render()
        return observation

    def render(self) -> np.ndarray:
        """(size, size, 3) uint8: mass red, puck green, goal blue."""
        image = np.full((self._size, self._size, 3), 240, np.uint8)
        goal = _GOALS.get(self._task.name, (0.0, 0.0)) if self._task else (0.0, 0.0)
        for place, colour in (
            (goal, (40, 60, 220)),
            (self._state[4:6], (30, 160, 60)),
            (self._state[:2], (220, 40, 40)),
        ):
            column, row = ((np.asarray(place) * [1, -1] + 1) / 2 * (self._size - 1)).astype(int)
            image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = colour
        return image

    def succeeded(self) -> bool:
        """Whether the puck is inside the task's goal."""
        if self._task is None or self._task.name not in _GOALS:
            return False
        return float(np.linalg.norm(self._state[4:6] - _GOALS[self._task.name])) < _GOAL_RADIUS_M

    def progress(self) -> float:
        """How much nearer to the goal the puck is than it was at the reset."""
        if self._task is None or self._task.name not in _GOALS:
            return 0.0
        if self.succeeded():
            return 1.0
        goal = np.array(_GOALS[self._task.name])
        now, first = (float(np.linalg.norm(puck - goal)) for puck in (self._state[4:6], self._first_puck))
        return min(max(1.0 - now / first, 0.0), 0.99)

    def bodies(self) -> dict[str, Pose]:
        """Mass as end effector, and the puck."""
        upright = (0.0, 0.0, 0.0, 1.0)
        return {
            "eef": Pose((*self._state[:2].tolist(), 0.0), upright),
            "puck": Pose((*self._state[4:6].tolist(), 0.0), upright),
        }

    def reachable(self, action: np.ndarray) -> bool:
        """Whether the mass, once it had the velocity that is asked for, would stay inside the walls."""
        target = self._state[:2] + 0.6 * np.clip(action, -1.0, 1.0) * _DT_S
        return bool((np.abs(target) <= 1.0).all())

    def joint_margin_rad(self) -> float:
        """A point has no joints."""
        return float("inf")

    def workspace(self) -> Workspace:
        """Between the walls."""
        return Workspace((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.0)

    def state_sha256(self) -> str:
        """Hash of position, velocity and puck."""
        return hashlib.sha256(self._state.tobytes()).hexdigest()

    def snapshot(self) -> bytes:
        """State and step count."""
        return self._state.tobytes() + self._steps.to_bytes(8, "little")

    def restore(self, snapshot: bytes) -> None:
        """Puts state and step count back."""
        self._state = np.frombuffer(snapshot[:-8]).copy()
        self._steps = int.from_bytes(snapshot[-8:], "little")

    def fixtures(self) -> dict[str, Pose]:
        """None: the seed decides everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """The physics of this file."""
        return {"fake": "1"}

    def close(self) -> None:
        """Frees the locks; there is nothing else."""
        for lock in self._locks:
            lock.close()


def _taken(lock: IO[str]) -> bool:
    """Whether a lock was free, and now is not."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
