"""The point mass as a platform: everything but its simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.base import Controller, Expert, Platform
from lerobot_roborecover.platforms.controls import Controls
from lerobot_roborecover.platforms.fake.simulator import FAKE_TASKS
from lerobot_roborecover.scenario import Task

HORIZON = 60


class FakePlatform(Platform):
    """A point mass that pushes a puck, and simulators that break on purpose."""

    name = "fake"
    title = "the fake simulator"
    action_widths = (2,)
    control_hz = 20.0
    settle_steps = 2
    env_config_class = "lerobot_roborecover.platforms.fake.env_config:FakeConfig"
    simulator = "lerobot_roborecover.platforms.fake.simulator:FakeSimulator"

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """Suites `toy` and `faults`."""
        return tuple(
            Task(self.name, suite, name, instruction, HORIZON)
            for suite, names in FAKE_TASKS.items()
            for name, instruction in names.items()
        )

    def check_task(self, task: Task) -> None:
        """The simulator does; tests make tasks of their own."""

    def picture_options(self, size: int) -> dict[str, Any]:
        """Square pictures have one size."""
        return {"obs_type": "pixels_agent_pos", "observation_size": size} if size else {"obs_type": "state"}

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """By the four values of its state and the six of its environment's."""
        environment = observation.get("observation.environment_state", ())
        return observation.get("observation.state", ())[-1:] == (4,) and environment[-1:] == (6,)

    def controls(self) -> Controls:
        """Two directions."""
        return Controls("fake", 2, {"forward": (1, 1.0), "left": (0, -1.0)})


def _pusher(lag: float, about: str) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        """Goes around the puck and pushes it at the goal."""
        goal = np.array({"push-left": (-0.3, 0.0)}.get(task.name, (0.3, 0.0)))
        offset = rng.uniform(-lag, lag, 2)

        def act(_t: int) -> np.ndarray:
            poses = simulator.bodies()
            mass, puck = (np.array(poses[n].position_m[:2]) for n in ("eef", "puck"))
            puck = puck + offset
            toward = (goal - puck) / max(float(np.linalg.norm(goal - puck)), 1e-6)
            gap = mass - puck
            along = float(gap @ toward)
            across = np.array([-toward[1], toward[0]])
            if along < 0 and abs(float(gap @ across)) < 0.03:
                target = goal
            elif along > -0.04:
                target = puck + across * np.sign(float(gap @ across) or 1.0) * 0.13 - 0.05 * toward
            else:
                target = puck - 0.11 * toward
            return np.clip(8.0 * (target - mass), -1.0, 1.0)

        return act

    return Expert(make, about)


FakePlatform.experts = {
    "expert": _pusher(0.0, "pushes the puck"),
    "expert_biased": _pusher(0.1, "sees the puck off"),
}

PLATFORM = FakePlatform()
