"""LIBERO as a platform: everything but its simulator."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.base import Controller, Expert, Platform
from lerobot_roborecover.platforms.controls import AXES, Controls
from lerobot_roborecover.platforms.findings import Check, Status
from lerobot_roborecover.platforms.libero.assets import ASSETS_VARIABLE
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.platforms.starts import RELEASE_SEED, Starts
from lerobot_roborecover.scenario import Reset, Task

_OPEN_M = 0.07
"""Opening of the two fingers together from which a gripper counts as open."""


class LiberoPlatform(Platform):
    """The forty tasks of LIBERO's four suites."""

    name = "libero"
    title = "LIBERO"
    action_widths = (7,)
    control_hz = 20.0
    action_names = {7: ("forward", "left", "up", "roll", "pitch", "yaw", "gripper")}
    axis_angle = {8: (3, 4, 5)}
    records_control_mode = "relative"
    settle_steps = 10  # LeRobot and the paper's release
    images_rotated_180 = True
    # MuJoCo 3.4 changed box contacts: LIBERO-Spatial task 5 falls from 98 % to 12 %
    # (https://github.com/huggingface/lerobot/issues/4390). robosuite 1.4.1, which the paper used, differs
    # from 1.4.0 in refactors and new objects only.
    required_versions = {
        "lerobot": ("0.6.1",),
        "mujoco": ("3.3.2",),
        "robosuite": ("1.4.0", "1.4.1"),
        "hf-libero": ("0.1.4",),
    }
    extra = "libero"
    simulator = "lerobot_roborecover.platforms.libero.simulator:LiberoSimulator"
    env_config_class = "lerobot_roborecover.platforms.libero.env_config:LiberoConfig"
    default_scenarios = "libero_recovery"
    default_split = "test"
    observation_options = (
        *Platform.observation_options,
        ("camera_name", "agentview_image,robot0_eye_in_hand_image"),
    )

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """By suite, in hf-libero's order."""
        return _tasks()

    def resets(self, task: Task, starts: Starts) -> list[Reset]:
        """From the task's stored init states."""
        from lerobot_roborecover.platforms.libero.init_states import read_init_states

        count = 0 if starts.seeds else len(read_init_states(task.suite, task.name))
        return starts.by_init_state(task, count, self.settle_steps)

    def first_reset(self, task: Task, seed: int | None = None, init_state: int | None = None) -> Reset:
        """Init states differ by their index; the seed decides where fixtures stand."""
        return Reset(RELEASE_SEED if seed is None else seed, init_state or 0, self.settle_steps)

    def another_reset(self, task: Task, number: int) -> Reset:
        """The next init state."""
        return self.first_reset(task, init_state=number)

    def no_op(self) -> np.ndarray:
        """Stay, gripper open; what LIBERO settles with."""
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])

    def unsupported_reason(self, task: Task) -> str:
        """The scripted controllers know all predicates of the four suites."""
        from lerobot_roborecover.platforms.libero.catalog import PREDICATES, libero_goal

        unknown = [p for p in libero_goal(task.suite, task.name) if p[0] not in PREDICATES]
        if not unknown:
            return ""
        return "no scripted controller knows " + ", ".join(" ".join(predicate) for predicate in unknown)

    def short_name(self, task: Task) -> str:
        """With the suite: names occur in several."""
        return f"{task.suite.removeprefix('libero_')}-{task.name}"

    def process_observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """LeRobot's `LiberoProcessorStep`."""
        from lerobot.processor.env_processor import LiberoProcessorStep

        return LiberoProcessorStep().observation(observation)

    def gripper_closed(self, state: np.ndarray) -> bool:
        """By the opening of the two fingers."""
        return bool(np.abs(state[6:8]).sum() < _OPEN_M)

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """By the eight values of its state."""
        return observation.get("observation.state", ())[-1:] == (8,)

    def controls(self) -> Controls:
        """Six directions and a gripper."""
        return Controls(
            "libero", 7, {name: (i, 1.0) for i, name in enumerate(AXES)}, (6, -1.0, 1.0),
            captions={
                "observation.images.image": "the robot faces you: W comes nearer",
                "observation.images.image2": "wrist camera",
            },
            live_options={"render_quality": "fast"},
        )  # fmt: skip

    def examine(self, required: bool, recorded: Mapping[str, str]) -> list[Check]:
        """Meshes and textures; nothing is downloaded here."""
        from lerobot_roborecover.platforms import versions
        from lerobot_roborecover.platforms.libero.assets import find_assets

        name = "LIBERO assets"
        status = Status.FAILURE if required else Status.WARNING
        if versions.installed("hf-libero") is None:
            return [Check(name, status, "hf-libero is not installed", self.install_command)]
        try:
            return [Check(name, Status.OK, str(find_assets(download=False)))]
        except SimulatorError as err:
            return [Check(name, status, "no complete folder", str(err))]

    def environment_fingerprint(self, options: Mapping[str, Any]) -> dict[str, str | None]:
        """The folder of assets."""
        return {"assets_dir": options.get("assets_dir"), ASSETS_VARIABLE: os.environ.get(ASSETS_VARIABLE)}


@cache
def _tasks() -> tuple[Task, ...]:
    from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS, libero_instruction, libero_tasks

    return tuple(
        Task("libero", suite, name, libero_instruction(name), LIBERO_HORIZONS[suite])
        for suite, names in libero_tasks().items()
        for name in names
    )


def _scripted(flaws: Callable[[np.random.Generator], Mapping[str, Any]], about: str) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        from lerobot_roborecover.platforms.libero.expert import Flaws, LiberoExpert
        from lerobot_roborecover.platforms.libero.scene import LiberoScene

        driver = LiberoExpert(LiberoScene(simulator), Flaws(**flaws(rng)))
        return lambda _t: driver.act()

    return Expert(make, about)


def _drawn_flaw(rng: np.random.Generator) -> dict[str, Any]:
    """One of the flaws of the starter set's controllers, which fit any pick-and-place task, and its size."""
    angle, side = rng.uniform(0, 2 * np.pi), np.zeros(3)
    side[:2] = np.cos(angle), np.sin(angle)
    kinds = (
        {"aim_m": tuple((rng.uniform(0.03, 0.06) * side).tolist())},
        {"turn_rad": float(rng.uniform(1.2, 1.6))},
        {"drop_after": int(rng.integers(3, 18))},
        {"place_m": tuple((rng.uniform(0.06, 0.11) * side[:2]).tolist())},
        {"carry_m": -float(rng.uniform(0.08, 0.14))},
    )
    return {"open_loop": True, **kinds[int(rng.integers(len(kinds)))]}


LiberoPlatform.experts = {
    "scripted": _scripted(lambda _r: {}, "every goal of a task in turn, tries again"),
    "scripted-open-loop": _scripted(lambda _r: {"open_loop": True}, "plans once, one attempt"),
    "scripted-weak": _scripted(_drawn_flaw, "one attempt with a flaw that it draws"),
}

PLATFORM = LiberoPlatform()
