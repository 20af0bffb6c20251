"""LIBERO behind the simulator protocol: hf-libero's environments, task files and init states, exact."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from functools import cached_property
from importlib import metadata
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.libero.assets import find_assets, physics_hash, quiet_import
from lerobot_roborecover.platforms.libero.goal_state import ENVIRONMENT_STATE_DIM
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.task import FirstReset, LiberoTask
from lerobot_roborecover.platforms.libero.view import LiberoView, ObservableClock
from lerobot_roborecover.platforms.limits import Workspace
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, Task

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import LiberoEnv
import ctypes
import gc
import sys
from collections.abc import Callable

CAMERA_NAMES = {"agentview_image": "image", "robot0_eye_in_hand_image": "image2"}
"""LeRobot's names of LIBERO's two cameras (lerobot/envs/libero.py)."""

RENDER_QUALITIES = ("full", "fast")
_OBS_TYPES = ("pixels", "pixels_agent_pos", "state")
_CONTROL_MODES = ("relative", "absolute")
_TASKS_KEPT = 1
"""Compiled tasks kept; one takes about 350 MB. Runs go task by task, so a second one would seldom be met
again."""


class LiberoSimulator:
    """LIBERO's forty tasks, with exact resets and snapshots, rendering only what is looked at.

    Observations, actions and camera names are those of LeRobot's `LiberoEnv`; pictures leave it rotated by
    180°, as there. Actions are relative after every reset, whatever `control_mode` says: call
    `set_control_mode` once the recorded prefix, which is relative, has been replayed.

    Args:
        assets_dir: LIBERO's assets; None looks where `find_assets` says.
        observation_height: pixels.
        observation_width: pixels.
        camera_name: comma-separated, or a list.
        camera_name_mapping: LeRobot's name of each camera; None for LeRobot's own.
        obs_type: `pixels`, `pixels_agent_pos`, or `state`: no pictures at all and no OpenGL, but
            `environment_state` (77,) float64, what `goal_state.ENVIRONMENT_STATE` says.
        control_mode: what the policy's actions are: `relative` or `absolute`.
        fps: control steps per simulated second.
        render_quality: `full` is LeRobot's, bit for bit; `fast` leaves out shadows, reflections,
            multisampling and most of the meshes' faces. The physics is the same.

    Raises:
        SimulatorError: an option is out of range, or LIBERO or its assets are missing.
    """

    platform = "libero"
    action_dim = 7
    snapshot_is_exact = True

    def __init__(
        self,
        assets_dir: str | None = None,
        observation_height: int = 360,
        observation_width: int = 360,
        camera_name: str | list[str] = "agentview_image,robot0_eye_in_hand_image",
        camera_name_mapping: Mapping[str, str] | None = None,
        obs_type: str = "pixels_agent_pos",
        control_mode: str = "relative",
        fps: int = 20,
        render_quality: str = "full",
    ):
        _require("obs_type", obs_type, _OBS_TYPES)
        _require("render_quality", render_quality, RENDER_QUALITIES)
        _require("control_mode", control_mode, _CONTROL_MODES)
        if fps < 1 or observation_height < 1 or observation_width < 1:
            raise SimulatorError(
                f"fps {fps}, observation_height {observation_height} and observation_width "
                f"{observation_width} must be at least 1"
            )
        names = camera_name.split(",") if isinstance(camera_name, str) else camera_name
        mapping = dict(camera_name_mapping or CAMERA_NAMES)
        self._cameras: dict[str, str] = {}
        for name in (n.strip() for n in names):
            if name not in mapping:
                raise SimulatorError(
                    f"camera_name_mapping names no key for camera {name!r}; it has {sorted(mapping)}"
                )
            self._cameras[mapping[name]] = name.removesuffix("_image")
        self.control_hz = float(fps)
        self.control_mode = control_mode
        self._size = (observation_height, observation_width)
        self._obs_type, self._fast = obs_type, render_quality == "fast"
        self.observation_space = _observation_space(obs_type, list(self._cameras), self._size)
        self._assets = find_assets(assets_dir)
        quiet_import(self._assets)
        self._tasks: OrderedDict[tuple[str, str], tuple[LiberoTask, LiberoView]] = OrderedDict()
        self._first_resets: dict[tuple[str, str], dict[int, FirstReset]] = {}
        self._clock: ObservableClock | None = None

    def reset(self, task: Task, reset: Reset) -> None:
        """Puts the task in its exact first state.

        That is the first reset of a fresh environment after `seed`, as in the paper's release, with the
        recorded fixture poses, if there are any, in place of the drawn ones. Another seed compiles the task
        anew, once.

        Raises:
            ScenarioError: LIBERO has no such task.
            SimulatorError: the reset lacks what LIBERO needs, or does not fit the task.
        """
        PLATFORM.check_task(task)
        if reset.init_state_index is None or (reset.seed is None and not reset.fixtures):
            raise SimulatorError(
                "a LIBERO reset needs init_state_index, and a seed or the fixtures' poses; got "
                f"init_state_index {reset.init_state_index}, seed {reset.seed}, {len(reset.fixtures)} poses"
            )
        key = (task.suite, task.name)
        kept = self._tasks.get(key)
        if kept is not None and not kept[0].can_reset(reset.seed):
            self._drop(key)
            kept = None
        compiles = kept is None
        if compiles:
            while len(self._tasks) >= _TASKS_KEPT:
                self._drop(next(iter(self._tasks)))
            built = LiberoTask(*key, self.control_hz, self._first_resets.setdefault(key, {}))
            kept = self._tasks[key] = (built, LiberoView(built, *self._size, self._fast))
        self._tasks.move_to_end(key)
        self._task, self._view = kept
        states = self._task.init_states
        if reset.init_state_index >= len(states):
            raise SimulatorError(
                f"{task.suite}/{task.name} has init states 0 to {len(states) - 1}, "
                f"got init_state_index {reset.init_state_index}"
            )
        try:
            self._task.reset(reset.seed, states[reset.init_state_index], reset.fixtures)
        except BaseException:
            self._drop(key)  # half reset
            raise
        if compiles:
            release_freed_memory()
        self._clock = ObservableClock(self._task.env.model_timestep, 1.0 / self.control_hz)
        self._view.sample()

    def step(self, action: np.ndarray) -> None:
        """Advances one control step without rendering; bit-identical to robosuite's `env.step`.

        Raises:
            SimulatorError: not reset, wrong action width, or unstable physics.
        """
        self._require_reset()
        if np.shape(action) != (self.action_dim,):
            raise SimulatorError(
                f"LIBERO takes actions of shape ({self.action_dim},), got {np.shape(action)}"
            )
        self._task.step(action, self._after_substep)

    def observe(self) -> Observation:
        """LeRobot's raw observation after the last step or reset; pictures rotated by 180°, as LeRobot's are.

        Raises:
            SimulatorError: not reset, or no OpenGL.
        """
        self._require_reset()
        observation: Observation = {}
        if self._obs_type != "state":
            observation["pixels"] = {
                key: self._view.frame(camera).copy() for key, camera in self._cameras.items()
            }
        if self._obs_type != "pixels":
            observation["robot_state"] = self._view.robot_state()
        if self._obs_type == "state":
            observation["environment_state"] = self._view.environment_state()
        return observation

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8 upright picture from the first camera.

        Raises:
            SimulatorError: not reset, or no OpenGL.
        """
        self._require_reset()
        return np.ascontiguousarray(self._view.frame(next(iter(self._cameras.values())))[::-1, ::-1])

    def succeeded(self) -> bool:
        """LIBERO's goal predicate, now."""
        self._require_reset()
        return bool(self._task.env._check_success())

    def progress(self) -> float:
        """The share of the goal's predicates that hold now: LIBERO's goals are conjunctions."""
        self._require_reset()
        env = self._task.env
        goals = env.parsed_problem["goal_state"]
        return sum(bool(env._eval_predicate(goal)) for goal in goals) / len(goals)

    def set_control_mode(self, mode: str) -> None:
        """Takes actions as `relative` or `absolute` until the next reset, which makes them relative again."""
        _require("control_mode", mode, _CONTROL_MODES)
        self._require_reset()
        self._task.robot.controller.use_delta = mode == "relative"

    def bodies(self) -> dict[str, Pose]:
        """World poses of the grip site (`eef`) and of everything that can move, the robot left out."""
        self._require_reset()
        return self._task.bodies()

    def reachable(self, action: np.ndarray) -> bool:
        """Whether inverse kinematics finds a posture within the joint limits for where the command would send
        the hand, and the controller's position limits, if it has any, allow it; see `libero_reach`."""
        self._require_reset()
        return self._task.reaches(np.asarray(action, dtype=np.float64))

    def joint_margin_rad(self) -> float:
        """Smallest distance of the arm's seven joints from their limits; negative beyond."""
        self._require_reset()
        return self._task.reach.margin_rad(self._task.data.qpos)

    def workspace(self) -> Workspace:
        """Over the table that the problem stands on, up to 1 m; see `LiberoTask.workspace`."""
        self._require_reset()
        return self._task.workspace()

    def state_sha256(self) -> str:
        """SHA-256 of the complete state that the continuation depends on."""
        self._require_reset()
        return self._task.state_sha256()

    def snapshot(self) -> bytes:
        """The complete state, a few kilobytes."""
        clock = self._require_reset()
        return self._task.snapshot(clock=clock.state)

    def restore(self, snapshot: bytes) -> None:
        """Puts a snapshot of the same task back; observations are valid after a further `step`.

        Raises:
            SimulatorError: not reset, or the snapshot is not of this task.
        """
        clock = self._require_reset()
        clock.state = self._task.restore(snapshot)["clock"]

    def fixtures(self) -> Mapping[str, Pose]:
        """Poses of the fixtures that LIBERO draws at random at each reset; its init states lack them."""
        self._require_reset()
        return self._task.fixtures()

    def fingerprint(self) -> dict[str, str]:
        """Versions that decide the physics; the assets by what of them collides, not by how they look."""
        return dict(self._fingerprint)

    def close(self) -> None:
        for key in list(self._tasks):
            self._drop(key)
        self._clock = None

    @property
    def libero_env(self) -> LiberoEnv:
        """hf-libero's environment of the current task, for scripted experts that read privileged state."""
        self._require_reset()
        return self._task.env

    @cached_property
    def _fingerprint(self) -> dict[str, str]:
        return {
            "mujoco": metadata.version("mujoco"),
            "robosuite": metadata.version("robosuite"),
            "hf-libero": metadata.version("hf-libero"),
            "libero_assets": physics_hash(self._assets),
        }

    def _after_substep(self) -> None:
        if self._require_reset().tick():
            self._view.sample()

    def _drop(self, key: tuple[str, str]) -> None:
        task, view = self._tasks.pop(key)
        view.close()
        task.close()
        if getattr(self, "_task", None) is task:
            self._clock = None

    def _require_reset(self) -> ObservableClock:
        if self._clock is None:
            raise SimulatorError("the LIBERO simulator was not reset; call reset(task, reset) first")
        return self._clock


def _require(option: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise SimulatorError(f"{option} {value!r} is not one of {', '.join(allowed)}")


def _observation_space(obs_type: str, images: list[str], size: tuple[int, int]) -> gym.spaces.Dict:
    """LeRobot's observation space of LIBERO (lerobot/envs/libero.py), plus what stands for pictures."""

    def real(*shape: int) -> gym.spaces.Box:
        return gym.spaces.Box(-np.inf, np.inf, shape, np.float64)

    spaces: dict[str, gym.Space] = {}
    if obs_type != "state":
        spaces["pixels"] = gym.spaces.Dict({k: gym.spaces.Box(0, 255, (*size, 3), np.uint8) for k in images})
    if obs_type != "pixels":
        spaces["robot_state"] = gym.spaces.Dict(
            {
                "eef": gym.spaces.Dict({"pos": real(3), "quat": real(4), "mat": real(3, 3)}),
                "gripper": gym.spaces.Dict({"qpos": real(2), "qvel": real(2)}),
                "joints": gym.spaces.Dict({"pos": real(7), "vel": real(7)}),
            }
        )
    if obs_type == "state":
        spaces["environment_state"] = real(ENVIRONMENT_STATE_DIM)
    return gym.spaces.Dict(spaces)


def _find_trim() -> Callable[[int], int] | None:
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's; musl has none


_TRIM = _find_trim()


def release_freed_memory() -> None:
    """Has the allocator return what it keeps for later: compiling a task takes far more than the task then
    needs. Does nothing where it cannot be known."""
    if _TRIM is not None:
        gc.collect()
        _TRIM(0)
