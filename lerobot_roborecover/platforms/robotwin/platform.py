"""RoboTwin 2.0 as a platform: everything but its simulator."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.base import Platform
from lerobot_roborecover.platforms.catalog import nearest
from lerobot_roborecover.platforms.controls import Controls
from lerobot_roborecover.platforms.findings import Check
from lerobot_roborecover.scenario import ScenarioError, Task

ROOT_VARIABLE = "ROBOTWIN_ROOT"
_JOINTS = ("1", "2", "3", "4", "5", "6")
_TURNED = ("x", "y", "z", "turn 1", "turn 2", "turn 3", "turn 4")
_LONG_HORIZON = 500
"""S from which Reversion goes back twice as far."""
_VULKAN_TIMEOUT_S = 120.0

# Step limits: `task_config/_eval_step_limit.yml` of RoboTwin, at the commit that LeRobot 0.6.1 pins:
# https://github.com/RoboTwin-Platform/RoboTwin
ACTION_DIMS = {"qpos": 14, "ee": 16}
"""By action type: two arms of six joints and a gripper; two end-effector poses (7) and a gripper."""
_TASKS_BY_LIMIT = {
    400: "adjust_bottle beat_block_hammer click_alarmclock click_bell grab_roller lift_pot move_can_pot "
    "move_pillbottle_pad move_playingcard_away move_stapler_pad pick_diverse_bottles pick_dual_bottles "
    "place_a2b_left place_a2b_right place_container_plate place_fan place_mouse_pad place_object_scale "
    "place_object_stand place_phone_stand press_stapler rotate_qrcode stamp_seal turn_switch",
    500: "place_bread_skillet place_burger_fries place_empty_cup place_shoe scan_object",
    600: "dump_bin_bigbin handover_mic place_dual_shoes",
    700: "open_laptop place_bread_basket place_can_basket place_object_basket put_object_cabinet "
    "shake_bottle shake_bottle_horizontally",
    800: "handover_block place_cans_plasticbox stack_blocks_two",
    900: "hanging_mug stack_bowls_two",
    1200: "blocks_ranking_rgb blocks_ranking_size stack_blocks_three stack_bowls_three",
    1500: "open_microwave",
    1700: "put_bottles_dustbin",
}
STEP_LIMITS = {name: limit for limit, names in _TASKS_BY_LIMIT.items() for name in names.split()}
"""S by task: new steps a trial may take."""


class RobotwinPlatform(Platform):
    """The fifty tasks of RoboTwin 2.0; its suites are the checkout's task configurations."""

    name = "robotwin"
    title = "RoboTwin"
    action_widths = (ACTION_DIMS["qpos"], ACTION_DIMS["ee"])
    control_hz = 50.0
    action_bound = math.inf  # joint targets are radians: LeRobot's own Box(-1, 1) does not fit them
    action_names = {
        14: tuple(f"{side} {n}" for side in ("left", "right") for n in (*_JOINTS, "gripper")),
        16: tuple(f"{side} {n}" for side in ("left", "right") for n in (*_TURNED, "gripper")),
    }
    clustered = True
    sizes_pictures = False
    apart = ("trajectory", "record", "instruction")
    # What the shipped set was recorded with: physics is SAPIEN's, and toppra times every joint action.
    required_versions = {"lerobot": ("0.6.1",), "sapien": ("3.0.3",), "toppra": ("0.6.10",)}
    extra = "robotwin"
    simulator = "lerobot_roborecover.platforms.robotwin.simulator:RobotwinSimulator"
    env_config_class = "lerobot_roborecover.platforms.robotwin.env_config:RobotwinConfig"
    default_scenarios = "robotwin_starter"
    observation_options = (
        *Platform.observation_options,
        ("camera_names", "head_camera,left_camera,right_camera"),
        ("mosaic", True),
    )
    perturbable = False
    why_not_perturbable = (
        "RoboTwin's actions are joint targets, or absolute poses that a planner turns "
        "into joint motion; they have no normalised translations to perturb (the paper perturbs "
        "LIBERO alone)"
    )

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """Returns the tasks in the checkout (option `robotwin_root`), in each of its configurations."""
        from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout

        checkout = RobotwinCheckout((options or {}).get("robotwin_root"))
        return tuple(
            # LeRobot's, where the official generator is not asked for (lerobot/envs/robotwin.py)
            Task(self.name, suite, name, name.replace("_", " "), horizon)
            for suite in checkout.task_configs
            for name, horizon in checkout.step_limits.items()
        )

    def task(self, name: str, instruction: str = "", suite: str = "") -> Task:
        """By RoboTwin's own list, without a checkout; its instructions are drawn, so that one is needed."""
        if name not in STEP_LIMITS:
            raise ScenarioError(
                f"task {name!r:.120} is not one of RoboTwin's {len(STEP_LIMITS)} tasks"
                f"{nearest(name, STEP_LIMITS)}"
            )
        return Task(self.name, suite or "demo_clean", name, instruction, STEP_LIMITS[name])

    def task_by_instruction(self, instruction: str, suite: str = "") -> Task:
        """There is no fixed instruction."""
        raise ScenarioError("tasks of robotwin have no fixed instruction; name the task")

    def check_task(self, task: Task) -> None:
        """By RoboTwin's own list; the suite is one of the checkout's configurations, which the simulator
        checks."""
        if task.name not in STEP_LIMITS:
            raise ScenarioError(f"robotwin has no task {task.name!r}{nearest(task.name, STEP_LIMITS)}")

    def rewind_steps(self, horizon: int) -> int:
        """60 from a horizon of 500 (paper, "Reversion Results")."""
        return 60 if horizon >= _LONG_HORIZON else 30

    def random_actions(self, rng: np.random.Generator, steps: int, width: int) -> np.ndarray:
        """Joint targets near the home posture."""
        return rng.uniform(-0.1, 0.1, (steps, width))

    def policy_action_width(self, options: Mapping[str, Any], recorded: int) -> int:
        """Joint targets or end-effector poses: the run's option, whatever the scenario was recorded in."""
        return ACTION_DIMS["ee" if options.get("action_mode", "joint") == "ee" else "qpos"]

    def picture_options(self, size: int) -> dict[str, Any]:
        """The size of pictures is the task configuration's."""
        return {"obs_type": "pixels_agent_pos" if size else "state"}

    def owns_observation(self, observation: Mapping[str, tuple[int, ...]]) -> bool:
        """By the width of its state."""
        return observation.get("observation.state", ())[-1:] in ((14,), (16,))

    def controls(self) -> Controls:
        raise ScenarioError(
            "RoboTwin cannot be driven by hand: an action is 14 absolute joint targets, or absolute poses "
            "through a motion planner, and takes 50 to 750 physics steps, so that there is no small motion "
            "that a key could stand for. Take rollouts of policies or of its scripted expert instead"
        )

    def examine(self, required: bool, recorded: Mapping[str, str]) -> list[Check]:
        """Checkout, robot, objects, Vulkan and planners."""
        from lerobot_roborecover.platforms.probe import run_probe
        from lerobot_roborecover.platforms.robotwin import checks

        # The one that may take long waits for a process.
        probe = run_probe("platforms.robotwin.probe_vulkan", timeout_s=_VULKAN_TIMEOUT_S)
        return [
            *checks.check_checkout(required, recorded),
            checks.check_vulkan(probe, required),
            *checks.check_planners(),
        ]

    def environment_fingerprint(self, options: Mapping[str, Any]) -> dict[str, str | None]:
        return {"robotwin_root": options.get("robotwin_root"), ROOT_VARIABLE: os.environ.get(ROOT_VARIABLE)}


PLATFORM = RobotwinPlatform()
