"""Meta-World as a platform: everything but its simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.base import Controller, Expert, Platform
from lerobot_roborecover.platforms.controls import Controls
from lerobot_roborecover.scenario import Task

_OPEN = 0.9
"""Meta-World's own number for the gripper's opening, from which it counts as open."""


class MetaworldPlatform(Platform):
    """The fifty tasks, by LeRobot's difficulty group."""

    name = "metaworld"
    title = "Meta-World"
    action_widths = (4,)
    control_hz = 80.0
    action_names = {4: ("right", "forward", "up", "gripper")}
    required_versions = {"lerobot": ("0.6.1",), "mujoco": ("3.3.2",), "metaworld": ("3.0.0",)}
    simulator = "lerobot_roborecover.platforms.metaworld.simulator:MetaworldSimulator"
    env_config_class = "lerobot_roborecover.platforms.metaworld.env_config:MetaworldConfig"
    default_scenarios = "metaworld_starter"

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """With LeRobot's difficulty group as suite and LeRobot's description as instruction."""
        return _tasks()

    def gripper_closed(self, state: np.ndarray) -> bool:
        """By its opening, the fourth value."""
        return bool(state[3] < _OPEN)

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """By the four values of its state; beside an environment state of 39, or none."""
        environment = observation.get("observation.environment_state", (39,))
        return observation.get("observation.state", ())[-1:] == (4,) and environment[-1:] == (39,)

    def controls(self) -> Controls:
        """Three directions and a gripper."""
        columns = {"forward": (1, 1.0), "left": (0, -1.0), "up": (2, 1.0)}
        return Controls(
            "metaworld", 4, columns, (3, -1.0, 1.0),
            captions={"observation.image": "W goes to the right, A to the back"},
            live_options={"render_quality": "fast"},
        )  # fmt: skip


@cache
def _tasks() -> tuple[Task, ...]:
    from lerobot_roborecover.platforms.metaworld.catalog import (
        HORIZON,
        metaworld_instruction,
        metaworld_tasks,
    )

    return tuple(
        Task("metaworld", suite, name, metaworld_instruction(name), HORIZON)
        for suite, names in metaworld_tasks().items()
        for name in names
    )


def _own(function: str, about: str) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        from lerobot_roborecover.platforms.metaworld import experts

        if function == "expert":
            return experts.expert(simulator, task.name)
        return getattr(experts, function)(simulator, task.name, rng)

    return Expert(make, about)


MetaworldPlatform.experts = {
    "expert": _own("expert", "Meta-World's own scripted policy"),
    "expert_biased": _own("biased_expert", "sees the object 1.5 to 4.5 cm off"),
    "expert_weak_grip": _own("weak_grip_expert", "closes with 3 to 30 % of the force"),
    "patient_expert": _own("patient_expert", "backs off and tries again"),
}

PLATFORM = MetaworldPlatform()
