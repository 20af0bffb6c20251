"""ManiSkill3's table-top tasks as two platforms of RoboRecover, one for each robot: what is not physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lerobot_roborecover.platforms import Platform
from lerobot_roborecover.platforms.controls import AXES, Controls
from lerobot_roborecover.scenario import ScenarioError, Task
from roborecover_maniskill.experts import EXPERTS, PLANS

OBJECTS = 3
SCENE_DIM = 7 * (2 + OBJECTS)
"""Hand, goal, and up to three objects in the order of their names: position in metres, quaternion xyzw; zeros
for what a task does not have."""


class Row(NamedTuple):
    """A task."""

    instruction: str
    horizon: int
    """Steps: ManiSkill's own `max_episode_steps`."""
    handled: str = ""
    """The actor that the task is about."""
    goal: str = ""
    """The actor that says where it has to go, and how far above that, metres."""
    above_m: float = 0.0


PANDA_TASKS = {
    "PickCube-v1": Row("pick up the red cube and hold it at the green mark", 50, "cube", "goal_site"),
    "PushCube-v1": Row("push the cube forward onto the target", 50, "cube", "goal_region", 0.02),
    "PullCube-v1": Row("pull the cube back onto the target", 50, "cube", "goal_region", 0.02),
    "StackCube-v1": Row("stack the red cube on the green cube", 50, "cubeA", "cubeB", 0.04),
    "PlaceSphere-v1": Row("put the sphere into the bin", 50, "sphere", "bin", 0.0225),
    "PokeCube-v1": Row("push the cube onto the target with the peg", 50, "cube", "goal_region", 0.02),
    "LiftPegUpright-v1": Row("stand the peg upright", 50),
    "RollBall-v1": Row("roll the ball onto the target", 80, "ball", "goal_region", 0.035),
    "PullCubeTool-v1": Row("pull the cube close with the L-shaped tool", 100),
    "PegInsertionSide-v1": Row("insert the orange end of the peg into the box", 100),
    "PlugCharger-v1": Row("plug the charger into the receptacle", 200),
    "StackPyramid-v1": Row("put the red cube next to the green one, and the blue cube on both", 250),
}
SO100_TASKS = {
    "PickCubeSO100-v1": Row("pick up the red cube and hold it at the green mark", 50, "cube", "goal_site"),
    "SO100GraspCube-v1": Row("grasp the cube and lift it to the rest pose", 64),
}


class ManiSkillPlatform(Platform):
    """What both robots share."""

    control_hz = 20.0
    simulator = "roborecover_maniskill.simulator:ManiSkillSimulator"
    distribution = "roborecover-maniskill"
    required_versions = {"mani-skill": ("3.0.1",), "sapien": ("3.0.3",)}  # noqa: RUF012 - a ClassVar
    experts = EXPERTS
    catalogue: Mapping[str, Row]
    joints: int

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """One suite, with ManiSkill's names."""
        return tuple(
            Task(self.name, "tabletop", n, row.instruction, row.horizon) for n, row in self.catalogue.items()
        )

    def make_simulator(self, **options: Any) -> Any:
        """The simulator of this robot."""
        return super().make_simulator(robot=self.name, **options)

    def picture_options(self, size: int) -> dict[str, Any]:
        """Square pictures have one size."""
        return {"obs_type": "pixels_agent_pos", "observation_size": size} if size else {"obs_type": "state"}

    def unsupported_reason(self, task: Task) -> str:
        """The scripted controllers know some tasks."""
        return "" if task.name in PLANS else "it is not scripted"

    def env_config(self) -> type:
        """LeRobot's view; imported here because LeRobot takes fifteen seconds."""
        from lerobot_roborecover.platforms.plain_config import plain_config

        return plain_config(self.action_widths[0], agent_pos=self.joints, environment_state=SCENE_DIM)


class PandaPlatform(ManiSkillPlatform):
    """A Franka Panda whose hand is moved (`pd_ee_delta_pose`: up to 0.1 m and 0.1 rad a step)."""

    name, title = "maniskill", "ManiSkill3, Panda"
    catalogue, joints, action_widths = PANDA_TASKS, 9, (7,)
    action_names = {7: (*AXES, "gripper")}  # noqa: RUF012
    gripper_commands = (1.0, -1.0)

    def controls(self) -> Controls:
        """Forward is +x, left is +y; ManiSkill turns by the negative of what is asked."""
        columns = {name: (i, 1.0 if i < 3 else -1.0) for i, name in enumerate(AXES)}
        return Controls(self.name, 7, columns, (6, 1.0, -1.0))

    def no_op(self) -> np.ndarray:
        """The gripper's value is a position: open."""
        return np.array([0.0, 0, 0, 0, 0, 0, 1])


class So100Platform(ManiSkillPlatform):
    """An SO-100 whose joints are moved (`pd_joint_target_delta_pos`: up to 0.05 rad a step, gripper 0.2)."""

    name, title = "maniskill_so100", "ManiSkill3, SO-100"
    catalogue, joints, action_widths = SO100_TASKS, 6, (6,)
    action_names = {6: ("pan", "lift", "elbow", "wrist flex", "wrist roll", "jaw")}  # noqa: RUF012

    def controls(self) -> Controls:
        """None: joints have no directions."""
        raise ScenarioError("the SO-100's actions are joints: keys for directions do not move it")


PANDA, SO100 = PandaPlatform(), So100Platform()
