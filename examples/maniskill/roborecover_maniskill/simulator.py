"""ManiSkill3 behind RoboRecover's simulator protocol, on the processor (`physx_cpu`).

Non-obvious behaviours this file deals with (mani-skill 3.0.1, sapien 3.0.3):

- A reset keeps the scene, and with it what PhysX remembers of contacts; some tasks draw sizes only where the
  scene is built. Every reset builds the scene anew (0.2 to 0.4 s).
- `SO100GraspCube-v1` moves its camera at every step by torch's global random stream: turned off.
- `set_state` puts back poses and velocities and nothing else; what follows drifts. Snapshots are refused.
- `gym.make` wraps a time limit around the environment, and `terminated` is success or failure: neither is
  used, only `info["success"]`.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401 - registers the tasks
import numpy as np
from mani_skill.utils.logging_utils import logger

from lerobot_roborecover.platforms import Observation, SimulatorError, platform_named
from lerobot_roborecover.platforms.simulator import GOAL, HANDLE
from lerobot_roborecover.scenario import Pose, Reset, Task
from roborecover_maniskill import OBJECTS, SCENE_DIM

CONTROL_MODES = {"maniskill": "pd_ee_delta_pose", "maniskill_so100": "pd_joint_target_delta_pos"}
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class ManiSkillSimulator:
    """One task at a time, reset by seed.

    Args:
        robot: name of the platform: decides tasks and actions.
        obs_type: `state`, or `pixels_agent_pos` with the picture of the task's `base_camera`.
        observation_size: side of pictures, pixels.
    """

    control_hz = 20.0
    snapshot_is_exact = False

    def __init__(self, robot: str = "maniskill", obs_type: str = "state", observation_size: int = 128):
        self.platform, self._own = robot, platform_named(robot)
        self.action_dim = self._own.action_widths[0]
        self._pictures, self._size = obs_type == "pixels_agent_pos", observation_size
        self.env: Any = None
        self._task, self._success = "", False
        widths = {"agent_pos": self._own.joints, "environment_state": SCENE_DIM}
        spaces: dict[str, gym.Space[Any]] = {
            name: gym.spaces.Box(-np.inf, np.inf, (width,), np.float64) for name, width in widths.items()
        }
        if self._pictures:
            spaces["pixels"] = gym.spaces.Box(0, 255, (observation_size, observation_size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(spaces)

    def reset(self, task: Task, reset: Reset) -> None:
        """Builds the task's scene and lays it out as the seed says.

        Raises:
            SimulatorError: no such task, no seed, or no Vulkan device.
        """
        tasks = self._own.catalogue
        if task.name not in tasks:
            raise SimulatorError(f"{self.platform} has no task {task.name!r}; there are {', '.join(tasks)}")
        if reset.seed is None:
            raise SimulatorError(f"task {task.name}: reset.seed is None; ManiSkill lays tasks out by a seed")
        if self._task != task.name:
            self.close()
            self.env, self._task = self._make(task.name), task.name
        self._success = bool(self.env.reset(seed=reset.seed, options={"reconfigure": True})[1]["success"])

    def step(self, action: np.ndarray) -> None:
        """Advances 50 ms; ManiSkill clips the action to [-1, 1] itself.

        Raises:
            SimulatorError: before a reset, or the action has another shape or is not finite.
        """
        action = np.asarray(action)
        if action.shape != (self.action_dim,) or not np.isfinite(action).all():
            wanted = f"{self.action_dim} finite numbers"
            raise SimulatorError(f"an action is {wanted}; got shape {action.shape}: {action}")
        self._success = bool(self._ready().step(action.astype(np.float32))[4]["success"])

    def observe(self) -> Observation:
        """Joints (rad; the Panda's fingers m), the scene (`SCENE_DIM`), and a picture where asked for."""
        env, bodies = self._ready(), self.bodies()
        objects = [pose for name, pose in bodies.items() if "." not in name and name not in ("eef", GOAL)]
        scene = np.zeros((2 + OBJECTS, 7))
        for row, pose in zip(scene, [bodies["eef"], bodies.get(GOAL), *objects[:OBJECTS]], strict=False):
            row[:] = (*pose.position_m, *pose.quat_xyzw) if pose else 0.0
        joints = env.agent.robot.get_qpos()[0].double().numpy()
        seen: Observation = {"agent_pos": joints, "environment_state": scene.ravel()}
        if self._pictures:
            for goal in env._hidden_objects:
                goal.hide_visual()
            env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
            camera = env.scene.sensors["base_camera"]
            camera.capture()
            found = camera.get_obs(rgb=True, depth=False, position=False, segmentation=False)
            seen["pixels"] = found["rgb"][0].cpu().numpy()
        return seen

    def render(self) -> np.ndarray:
        """(size, size, 3) uint8 of the camera for people, which shows goals that policies do not see."""
        return self._ready().render_rgb_array()[0].cpu().numpy()

    def succeeded(self) -> bool:
        """ManiSkill's `info["success"]`."""
        return self._success

    def bodies(self) -> dict[str, Pose]:
        """The point between the fingers, what can move, and the marks of what the task is about."""
        env, row = self._ready(), self._own.catalogue[self._task]
        actors = sorted(env.scene.actors.items())
        poses = {n: _pose(actor.pose.raw_pose) for n, actor in actors if actor.px_body_type == "dynamic"}
        poses = {"eef": _pose(env.agent.tcp_pose.raw_pose), **poses}
        if row.goal:
            x, y, z = env.scene.actors[row.goal].pose.p[0].tolist()
            poses[row.handled + HANDLE] = Pose(poses[row.handled].position_m, _UPRIGHT)
            poses[GOAL] = Pose((x, y, z + row.above_m), _UPRIGHT)
        elif self._task == "PegInsertionSide-v1":
            poses["peg_0" + HANDLE] = Pose(tuple(env.peg_head_pos[0].tolist()), _UPRIGHT)
            poses[GOAL] = Pose(tuple(env.box_hole_pose.p[0].tolist()), _UPRIGHT)
        return poses

    def state_sha256(self) -> str:
        """Of poses and velocities of everything, joints, and what the controllers aim at."""
        env = self._ready()
        digest = hashlib.sha256(env.agent.robot.get_drive_targets().numpy().tobytes())
        for name, values in _arrays(env.get_state_dict()):
            digest.update(name.encode() + values.tobytes())
        return digest.hexdigest()

    def snapshot(self) -> bytes:
        """Refused."""
        raise SimulatorError("ManiSkill's set_state drifts: prefixes are replayed")

    def restore(self, snapshot: bytes) -> None:
        """Refused."""
        self.snapshot()

    def fixtures(self) -> Mapping[str, Pose]:
        """None: the seed decides everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """What decides the physics; torch computes what controllers aim at."""
        return {name: version(name) for name in ("mani-skill", "sapien", "torch")}

    def close(self) -> None:
        """Frees the scene."""
        if self.env is not None:
            self.env.close()
        self.env, self._task = None, ""

    def _ready(self) -> Any:
        if self.env is None:
            raise SimulatorError("step before reset: call reset(task, reset) first")
        return self.env

    def _make(self, name: str) -> Any:
        size = {"width": self._size, "height": self._size}
        extra = {"domain_randomization": False} if name == "SO100GraspCube-v1" else {}
        logger.setLevel(logging.ERROR)
        try:
            return gym.make(
                name, num_envs=1, obs_mode="none", reward_mode="none", sim_backend="physx_cpu",
                control_mode=CONTROL_MODES[self.platform], render_mode="rgb_array", sensor_configs=size,
                human_render_camera_configs=size, **extra,
            ).unwrapped  # fmt: skip
        except RuntimeError as err:
            driver = os.environ.get("VK_ICD_FILENAMES", "")
            raise SimulatorError(
                f"ManiSkill could not make {name} ({err}). SAPIEN needs a Vulkan device even for state, with "
                f"VK_ICD_FILENAMES={driver!r}: without a GPU, export VK_ICD_FILENAMES=$(scripts/vulkan.sh)"
            ) from err


def _pose(raw: Any) -> Pose:
    x, y, z, qw, qx, qy, qz = raw[0].tolist()
    return Pose((x, y, z), (qx, qy, qz, qw))


def _arrays(tree: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    for name, value in sorted(tree.items()):
        if isinstance(value, Mapping):
            yield from _arrays(value, f"{path}{name}/")
        else:
            yield f"{path}{name}", np.ascontiguousarray(value.numpy())
