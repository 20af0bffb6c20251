"""Env types that are known without importing LeRobot, which takes fifteen seconds: what their own configs and
packages say of them, and what those leave out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.base import Controller, Expert
from lerobot_roborecover.scenario import Task


@dataclass(frozen=True)
class EnvFacts:
    """Facts about an env type."""

    package: str
    """Module whose import registers the Gymnasium ids `<package>/<task>`."""
    title: str
    """For people."""
    tasks: Mapping[str, str]
    """Instruction by task."""
    horizon: int
    """`episode_length` of LeRobot's config, steps."""
    control_hz: float
    """`fps` of LeRobot's config."""
    action_names: tuple[str, ...]
    """What each value of an action is."""
    kwargs: Mapping[str, Any]
    """Arguments of the env where it renders nothing and no images are requested."""
    state_width: int
    """Values of `agent_pos`."""
    environment_width: int = 0
    """Values of `environment_state`; 0 where there is none."""
    versions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Distributions that decide scores, beside LeRobot."""
    perturbation: tuple[float, ...] = ()
    """Half-widths of the disturbance of an action's leading values, in the env's own units."""
    exact_snapshots: bool = False
    """A restored snapshot continues bit for bit: Python keeps nothing beside the physics."""
    scenarios: str = ""
    """Shipped set."""
    experts: Mapping[str, Expert] = field(default_factory=dict)


def _pusher(speed: float, error: float, about: str) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        from lerobot_roborecover.platforms.lerobot.pusht import Pusher

        return Pusher(simulator.env.unwrapped, rng, speed=speed, error=error)

    return Expert(make, about)


def _transfer(error_m: float, about: str) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        from lerobot_roborecover.platforms.lerobot.aloha import Transfer

        return Transfer(simulator.env.unwrapped, rng, error_m=error_m)

    return Expert(make, about)


_ARM = ("waist", "shoulder", "elbow", "forearm roll", "wrist angle", "wrist rotate", "gripper")

KNOWN: Mapping[str, EnvFacts] = {
    "pusht": EnvFacts(
        package="gym_pusht",
        title="PushT",
        tasks={"PushT-v0": "Push the T-shaped block onto the T-shaped target."},
        horizon=300,
        control_hz=10.0,
        action_names=("right", "down"),
        kwargs={"obs_type": "environment_state_agent_pos", "render_mode": "rgb_array"},
        state_width=2,
        environment_width=16,
        versions={"gym-pusht": ("0.1.8",), "pymunk": ("6.11.1",), "shapely": ("2.2.0",)},
        perturbation=(80.0, 80.0),
        scenarios="pusht_starter",
        experts={
            "expert": _pusher(1.0, 0.0, "plans its pushes in a copy of the simulator"),
            "expert_hurried": _pusher(2.5, 0.0, "pushes two and a half times as fast as it plans"),
            "expert_biased": _pusher(1.0, 12.0, "sees the block some 1.5 cm off"),
        },
    ),
    "aloha": EnvFacts(
        package="gym_aloha",
        title="Aloha",
        tasks={
            "AlohaTransferCube-v0": ("Pick up the cube with the right arm and transfer it to the left arm."),
            "AlohaInsertion-v0": "Insert the peg into the socket.",
        },
        horizon=400,
        control_hz=50.0,
        action_names=tuple(f"{side} {name}" for side in ("left", "right") for name in _ARM),
        kwargs={"obs_type": "pixels_agent_pos", "render_mode": "rgb_array"},
        state_width=14,
        versions={"gym-aloha": ("0.1.5",), "dm-control": ("1.0.30",), "mujoco": ("3.3.2",)},
        perturbation=(0.0,) * 7 + (0.15,) * 6,
        exact_snapshots=True,
        experts={
            "expert": _transfer(0.0, "transfers the cube, in half of its trials"),
            "expert_biased": _transfer(0.03, "the same, and sees the cube up to 3 cm off"),
        },
    ),
}
"""By env type."""
