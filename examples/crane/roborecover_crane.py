"""A platform in one file: a crane must set down a swinging load at rest over a mark.

Everything that RoboRecover asks of a simulator family is here, and nothing else is: the simulator, the
platform object, and LeRobot's view of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms import Observation, Platform, SimulatorError
from lerobot_roborecover.platforms.base import Controller, Expert
from lerobot_roborecover.platforms.controls import Controls
from lerobot_roborecover.scenario import Pose, Reset, Task

DT_S, ROPE_M, GRAVITY = 0.05, 1.0, 9.81
MARKS_M = {"to-the-ship": 1.5, "to-the-quay": -1.5}
"""Where each task wants the load."""
INSTRUCTIONS = {
    "to-the-ship": "set the load down on the ship",
    "to-the-quay": "set the load down on the quay",
}
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class CraneSimulator:
    """See `lerobot_roborecover.platforms.Simulator` for what each method promises."""

    platform = "crane"
    control_hz = 1 / DT_S
    action_dim = 1
    snapshot_is_exact = True

    def __init__(self, obs_type: str = "state", observation_size: int = 64):
        self._pictures, self._size = obs_type == "pixels_agent_pos", observation_size
        spaces: dict[str, gym.Space[Any]] = {
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (4,), np.float64),
            "environment_state": gym.spaces.Box(-np.inf, np.inf, (1,), np.float64),
        }
        if self._pictures:
            spaces["pixels"] = gym.spaces.Box(0, 255, (observation_size, observation_size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(spaces)
        self._state: np.ndarray | None = None
        self._mark_m = 0.0

    def reset(self, task: Task, reset: Reset) -> None:
        """The trolley stands somewhere in the middle, the load hangs still; the seed decides where."""
        if task.name not in MARKS_M:
            raise SimulatorError(f"crane has no task {task.name!r}; there are {', '.join(MARKS_M)}")
        start = np.random.default_rng(reset.seed).uniform(-0.5, 0.5)
        # Trolley (m), its velocity (m/s), the rope's angle (rad) and its velocity (rad/s).
        self._state, self._mark_m = np.array([start, 0.0, 0.0, 0.0]), MARKS_M[task.name]

    def step(self, action: np.ndarray) -> None:
        """One value: the trolley's acceleration, 1 being 2 metres per second squared."""
        x, v, angle, turn = self._ready()
        if np.shape(action) != (1,):
            raise SimulatorError(f"a crane's action is one number; got shape {np.shape(action)}")
        push = 2.0 * float(np.clip(action[0], -1.0, 1.0)) - 0.4 * v
        turn += DT_S * (-(GRAVITY * np.sin(angle) + push * np.cos(angle)) / ROPE_M - 0.05 * turn)
        v += DT_S * push
        self._state = np.array([np.clip(x + DT_S * v, -2.5, 2.5), v, angle + DT_S * turn, turn])

    def observe(self) -> Observation:
        """State, the mark, and a picture where asked for."""
        seen: Observation = {"agent_pos": self._ready().copy(), "environment_state": np.array([self._mark_m])}
        return seen | ({"pixels": self.render()} if self._pictures else {})

    def render(self) -> np.ndarray:
        """(size, size, 3) uint8: trolley red, load green, mark blue."""
        image = np.full((self._size, self._size, 3), 240, np.uint8)
        places = ((self._mark_m, -1.2), (self._ready()[0], 0.0), self._load_m())
        for (x, z), colour in zip(places, ((40, 60, 220), (220, 40, 40), (30, 160, 60)), strict=True):
            column, row = np.clip(
                np.array([(x + 3) / 6, (0.5 - z) / 2]) * self._size, 1, self._size - 2
            ).astype(int)
            image[row - 1 : row + 2, column - 1 : column + 2] = colour
        return image

    def succeeded(self) -> bool:
        """Over the mark to 10 cm, trolley and load nearly at rest."""
        x, v, angle, turn = self._ready()
        return bool(abs(x - self._mark_m) < 0.1 and abs(v) < 0.1 and abs(angle) < 0.05 and abs(turn) < 0.15)

    def bodies(self) -> dict[str, Pose]:
        """The trolley is what the robot moves, the load what the task is about."""
        x, z = self._load_m()
        return {"eef": Pose((self._ready()[0], 0.0, 0.0), UPRIGHT), "load": Pose((x, 0.0, z), UPRIGHT)}

    def state_sha256(self) -> str:
        """Of the whole state."""
        return hashlib.sha256(self._ready().tobytes()).hexdigest()

    def snapshot(self) -> bytes:
        """The state; the task comes with the reset."""
        return self._ready().tobytes()

    def restore(self, snapshot: bytes) -> None:
        """Puts it back."""
        self._state = np.frombuffer(snapshot).copy()

    def fixtures(self) -> Mapping[str, Pose]:
        """None: the seed decides everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """What decides the physics."""
        return {"crane": "1"}

    def close(self) -> None:
        """Nothing to free."""

    def _ready(self) -> np.ndarray:
        if self._state is None:
            raise SimulatorError("step before reset: call reset(task, reset) first")
        return self._state

    def _load_m(self) -> tuple[float, float]:
        x, _, angle, _ = self._ready()
        return float(x + ROPE_M * np.sin(angle)), float(-ROPE_M * np.cos(angle))


class CranePlatform(Platform):
    """Two tasks; see `lerobot_roborecover.platforms.Platform` for what else a platform can say."""

    name = "crane"
    title = "the crane"
    action_widths = (1,)
    control_hz = 1 / DT_S
    simulator = "roborecover_crane:CraneSimulator"
    distribution = "roborecover-crane"

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """One suite; ten seconds each."""
        return tuple(Task("crane", "harbour", name, said, 200) for name, said in INSTRUCTIONS.items())

    def picture_options(self, size: int) -> dict[str, Any]:
        """Square pictures have one size."""
        return {"obs_type": "pixels_agent_pos", "observation_size": size} if size else {"obs_type": "state"}

    def controls(self) -> Controls:
        """A person pushes the trolley left and right."""
        return Controls("crane", 1, {"left": (0, -1.0)})

    def env_config(self) -> type:
        """LeRobot's view; imported here because LeRobot takes fifteen seconds."""
        from lerobot_roborecover.platforms.plain_config import plain_config

        return plain_config(action=1, agent_pos=4, environment_state=1)


def _driver(hurry: float) -> Expert:
    """Drives to the mark and damps the swing; in a hurry it does not wait for the load."""

    def make(simulator: CraneSimulator, task: Task, rng: np.random.Generator) -> Controller:
        def act(_t: int) -> np.ndarray:
            x, v, angle, turn = simulator.observe()["agent_pos"]
            away = MARKS_M[task.name] - x
            return np.array([np.clip(hurry * away - 1.3 * v + (0.9 * angle + 0.4 * turn) / hurry, -1.0, 1.0)])

        return act

    return Expert(make, "sets the load down" if hurry < 1 else "is in a hurry")


CranePlatform.experts = {"careful": _driver(0.6), "hurried": _driver(3.0)}
PLATFORM = CranePlatform()
