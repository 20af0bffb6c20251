"""Meta-World behind the simulator protocol: fifty Sawyer tasks from PyPI alone, no assets to fetch.

Non-obvious behaviours this file deals with (metaworld 3.0.0):

- `SawyerXYZEnv.step` raises once 500 steps were taken since the reset; a prefix and a fresh budget cross
  that.
- A task object keeps reward bookkeeping between episodes (`pickCompleted` and the like); a reset puts it
  back.
- The goal is blanked out of the 39 numbers unless the environment is told to be fully observable. Physics,
  success and LeRobot's four numbers do not depend on it, so goals are always shown here.
- Gymnasium's offscreen viewer never makes its OpenGL context current again after another environment
  rendered.
"""

from __future__ import annotations

import copy
import sys
from collections import OrderedDict
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import metaworld
import mujoco
import numpy as np
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from lerobot_roborecover.platforms.limits import Workspace
from lerobot_roborecover.platforms.metaworld.marks import handled_body, marks
from lerobot_roborecover.platforms.metaworld.scene import (
    STEP_ATTRIBUTES,
    movable_bodies,
    render_frame,
    set_attributes,
    step_attributes,
    xyzw,
)
from lerobot_roborecover.platforms.mujoco_state import (
    hash_arrays,
    load_state,
    pack_arrays,
    save_state,
    subtree,
    unpack_arrays,
)
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, Task

OBS_TYPES = ("pixels", "pixels_agent_pos", "state")
RENDER_QUALITIES = ("full", "fast")
ENVIRONMENT_STATE_DIM = 39
_KEPT_ENVS = 4
"""Compiled tasks kept per simulator; one takes 0.02 to 0.4 s to build."""

_FINGERS_M = 0.05
"""How far the fingertips hang below the hand."""

_CORNER2_POSITION_M = (0.75, 0.075, 0.7)
"""Where LeRobot's MetaworldEnv moves the corner2 camera."""


class MetaworldSimulator:
    """One Meta-World task at a time, reset by seed.

    Args:
        observation_height: rows of a frame, pixels.
        observation_width: columns of a frame, pixels.
        camera_name: a camera of the Sawyer models; `corner2` is placed and turned as LeRobot does.
        obs_type: `pixels`, `pixels_agent_pos` (both exactly LeRobot's), or `state`, which never renders:
            `agent_pos` (4,) float64 hand position in metres and gripper opening in [0, 1], and
            `environment_state` (39,) float64, Meta-World's own observation with the goal shown.
        render_quality: `full` is LeRobot's; `fast` leaves out shadows and multisampling, which is where the
            time goes on a machine without a GPU.
    """

    platform = "metaworld"
    control_hz = 80.0
    action_dim = 4
    snapshot_is_exact = True

    def __init__(
        self,
        observation_height: int = 480,
        observation_width: int = 480,
        camera_name: str = "corner2",
        obs_type: str = "pixels_agent_pos",
        render_quality: str = "full",
    ):
        if render_quality not in RENDER_QUALITIES:
            raise SimulatorError(
                f"render_quality {render_quality!r} is not one of {', '.join(RENDER_QUALITIES)}"
            )
        if obs_type not in OBS_TYPES:
            raise SimulatorError(f"obs_type {obs_type!r} is not one of {', '.join(OBS_TYPES)}")
        self._height, self._width = observation_height, observation_width
        self._camera, self._obs_type, self._fast = camera_name, obs_type, render_quality == "fast"
        self._envs: OrderedDict[str, SawyerXYZEnv] = OrderedDict()
        self._env: SawyerXYZEnv | None = None
        self._first_attributes: dict[str, dict[str, Any]] = {}
        self._first_layouts: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._raw = np.zeros(ENVIRONMENT_STATE_DIM)
        self._success = False
        self._first_distance_m = self._distance_m = 0.0
        self._frame: np.ndarray | None = None
        self._first: mujoco.MjData | None = None
        self._behind = np.zeros(3)
        self._tracked: dict[str, int] = {}
        self._parts: dict[str, set[int]] = {}
        self._task_name = ""
        self._handled: str | None = None
        self._fingers: list[set[int]] = []
        spaces: dict[str, gym.Space[Any]] = {}
        if obs_type != "state":
            shape = (observation_height, observation_width, 3)
            spaces["pixels"] = gym.spaces.Box(0, 255, shape, np.uint8)
        if obs_type != "pixels":
            spaces["agent_pos"] = gym.spaces.Box(-1000.0, 1000.0, (4,), np.float64)
        if obs_type == "state":
            spaces["environment_state"] = gym.spaces.Box(
                -np.inf, np.inf, (ENVIRONMENT_STATE_DIM,), np.float64
            )
        self.observation_space = gym.spaces.Dict(spaces)

    def reset(self, task: Task, reset: Reset) -> None:
        """Puts a task in the first state of a seed.

        Raises:
            SimulatorError: the task is unknown, or the reset names no seed.
        """
        if reset.seed is None:
            raise SimulatorError(
                f"task {task.name}: reset.seed is None; a Meta-World task draws its object and goal "
                "positions from a seed, so the scenario's reset must name one (0 to 2^32 - 1)"
            )
        env = self._env = self._env_of(task.name)
        self._tracked = movable_bodies(env.model)
        self._parts = {name: subtree(env.model, [body]) for name, body in self._tracked.items()}
        self._fingers = [subtree(env.model, [env.model.body(f"{side}claw").id]) for side in ("right", "left")]
        # Meta-World's reset lays out the scene twice, and the first time starts from whatever state came
        # before: the first frame shows the goal marker some 0.01 mm off. Start from the freshly built state.
        mujoco.mj_resetData(env.model, env.data)
        env.model.body_pos[:], env.model.site_pos[:] = self._first_layouts[task.name]
        set_attributes(env, self._first_attributes[task.name])
        env._freeze_rand_vec = False
        env.seeded_rand_vec = True
        env.seed(reset.seed)
        self._raw, _ = env.reset(seed=reset.seed)
        self._task_name, self._handled = task.name, handled_body(env, self._parts, self._raw)
        env._last_stable_obs = None
        self._first_distance_m = self._distance_m = self._distance_now()
        self._success = False
        self._frame = None
        # Meta-World puts fixtures in place last, and what hangs on them follows with the first step: the
        # coffee machine's button is up to 60 mm off till then, a window 220. What is drawn and observed stays
        # so.
        self._first, self._behind = copy.copy(env.data), np.zeros(3)
        mujoco.mj_kinematics(env.model, self._first)
        if self._handled is not None:
            body = self._tracked[self._handled]
            self._behind = self._first.xipos[body] - env.data.xipos[body]

    def step(self, action: np.ndarray) -> None:
        """Advances 12.5 ms; see `Simulator.step`. Meta-World clips translations to [-1, 1] itself."""
        action = np.asarray(action)
        if action.shape != (self.action_dim,) or not np.isfinite(action).all():
            raise SimulatorError(
                f"a Meta-World action is 4 finite numbers, got shape {action.shape}: {action}"
            )
        self._raw, _, _, _, info = self._ready().step(action)
        self._first, self._behind = None, np.zeros(3)
        self._success = bool(info["success"])
        self._distance_m = float(info["obj_to_target"])
        self._frame = None

    def _distance_now(self) -> float:
        """`obj_to_target` of the present state; what working it out changes in the task is put back."""
        env = self._ready()
        before = step_attributes(env)
        _, info = env.evaluate_state(self._raw, np.zeros(self.action_dim, np.float32))
        set_attributes(env, before)
        return float(info["obj_to_target"])

    def observe(self) -> Observation:
        """LeRobot's raw observation, or the low-dimensional one; see the class."""
        self._ready()
        observation: Observation = {}
        if self._obs_type != "state":
            observation["pixels"] = self.render()
        if self._obs_type != "pixels":
            observation["agent_pos"] = self._raw[:4].copy()
        if self._obs_type == "state":
            observation["environment_state"] = self._raw.copy()
        return observation

    def render(self) -> np.ndarray:
        """(height, width, 3) uint8, upright.

        Raises:
            SimulatorError: there is no OpenGL context to be had.
        """
        if self._frame is None:
            image = render_frame(self._ready())
            # corner2 looks at the table upside down and mirrored; LeRobot turns it by 180 degrees.
            self._frame = np.flip(image, (0, 1)) if self._camera == "corner2" else image
        return self._frame.copy()

    def succeeded(self) -> bool:
        """Meta-World's own success of the last step; False right after a reset."""
        return self._success

    def progress(self) -> float:
        """1 on success; else by how much Meta-World's own `obj_to_target` is shorter than at the reset."""
        if self._success:
            return 1.0
        if not self._first_distance_m > 0.0:
            return 0.0
        return min(max(1.0 - self._distance_m / self._first_distance_m, 0.0), 0.99)

    def low_dim(self) -> np.ndarray:
        """(39,) float64: Meta-World's observation with the goal shown, whatever `obs_type`."""
        self._ready()
        return self._raw.copy()

    def grasped(self) -> set[str]:
        """Tracked bodies that both fingers touch."""
        env = self._ready()
        bodies = env.model.geom_bodyid[env.data.contact.geom]
        pairs = {(int(a), int(b)) for pair in bodies for a, b in (pair, pair[::-1])}
        right, left = ({b for a, b in pairs if a in finger} for finger in self._fingers)
        return {name for name, parts in self._parts.items() if right & parts and left & parts}

    def bodies(self) -> dict[str, Pose]:
        """`eef`: between the fingertips, turned as the hand. The rest by centre of mass: hinges show. Beside
        them the marks of `metaworld_marks`."""
        env = self._ready()
        data = env.data if self._first is None else self._first
        poses = {"eef": Pose(tuple(env.tcp_center), xyzw(data.body("hand").xquat))}
        for name, body in self._tracked.items():
            poses[name] = Pose(tuple(data.xipos[body]), xyzw(data.xquat[body]))
        return poses | marks(self._task_name, self._handled, self._raw, self._behind)

    def state_sha256(self) -> str:
        """Hash of the integration state, of the fixtures' places, and of the observation stack."""
        env = self._ready()
        return hash_arrays(save_state(env.model, env.data), env.model.body_pos, env._prev_obs, self._raw)

    def snapshot(self) -> bytes:
        """See `Simulator.snapshot`; some 4 KB."""
        env = self._ready()
        attributes = {f"attribute.{k}": np.array(v) for k, v in step_attributes(env).items() if v is not None}
        return pack_arrays(
            state=save_state(env.model, env.data),
            path_length=np.array(env.curr_path_length),
            previous=env._prev_obs,
            raw=self._raw,
            success=np.array(self._success),
            behind=self._behind,
            **attributes,
        )

    def restore(self, snapshot: bytes) -> None:
        """See `Simulator.restore`.

        Raises:
            SimulatorError: the snapshot cannot be read, or is of another task.
        """
        env = self._ready()
        arrays = unpack_arrays(snapshot)
        state = arrays["state"]
        load_state(env.model, env.data, state)
        mujoco.mj_forward(env.model, env.data)
        load_state(env.model, env.data, state)  # forward overwrote the solver's warm start
        env.curr_path_length = int(arrays["path_length"])
        env._prev_obs = arrays["previous"]
        attributes = {k: arrays.get(f"attribute.{k}") for k in STEP_ATTRIBUTES if hasattr(env, k)}
        set_attributes(env, {k: None if v is None else v.item() for k, v in attributes.items()})
        self._raw = arrays["raw"]
        self._success = bool(arrays["success"])
        self._frame = None
        self._first, self._behind = None, arrays.get("behind", np.zeros(3))

    def reachable(self, action: np.ndarray) -> bool:
        """Whether the hand's target stays between `mocap_low` and `mocap_high`, where
        `SawyerXYZEnv.set_xyz_action` would stop it. That a command is clipped to [-1, 1] is the input's range
        and no limit of reach."""
        env = self._ready()
        target = env.data.mocap_pos[0] + np.clip(action[:3], -1.0, 1.0) * env.action_scale
        return bool((target >= env.mocap_low).all() and (target <= env.mocap_high).all())

    def joint_margin_rad(self) -> float:
        """Infinite: the hand is pulled by a mocap body, the arm hangs on it and rests at a joint's limit for
        most of an ordinary success."""
        return float("inf")

    def workspace(self) -> Workspace:
        """The box of the hand's targets, with the fingertips' 5 cm below; the table's top is at 0."""
        env = self._ready()
        low = env.mocap_low - np.array([0.0, 0.0, _FINGERS_M])
        return Workspace(tuple(low.tolist()), tuple(env.mocap_high.tolist()), 0.0)

    def fixtures(self) -> Mapping[str, Pose]:
        """None: the seed decides everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """Versions that decide the physics."""
        return {"metaworld": version("metaworld"), "mujoco": mujoco.__version__}

    def close(self) -> None:
        """Frees the compiled tasks and their OpenGL contexts."""
        for env in self._envs.values():
            env.close()
        self._envs.clear()
        self._env = None

    def _ready(self) -> SawyerXYZEnv:
        if self._env is None:
            raise SimulatorError("the simulator was not reset yet (or is closed); call reset first")
        return self._env

    def _env_of(self, name: str) -> SawyerXYZEnv:
        if name in self._envs:
            self._envs.move_to_end(name)
            return self._envs[name]
        if name not in metaworld.ALL_V3_ENVIRONMENTS:
            raise SimulatorError(
                f"metaworld {version('metaworld')} has no task {name!r}; its tasks are "
                f"{', '.join(sorted(metaworld.ALL_V3_ENVIRONMENTS))}"
            )
        env = metaworld.ALL_V3_ENVIRONMENTS[name](
            render_mode="rgb_array", camera_name=self._camera, height=self._height, width=self._width
        )
        if mujoco.mj_name2id(env.model, mujoco.mjtObj.mjOBJ_CAMERA, self._camera) < 0:
            cameras = [env.model.camera(i).name for i in range(env.model.ncam)]
            raise SimulatorError(f"task {name} has no camera {self._camera!r}; it has {', '.join(cameras)}")
        if self._camera == "corner2":
            env.model.cam_pos[env.model.camera("corner2").id] = _CORNER2_POSITION_M
        if self._fast:
            env.model.vis.quality.shadowsize = env.model.vis.quality.offsamples = 0
        # In place of `set_task`, which stores a random vector that a seeded reset overwrites, and visibility.
        env._set_task_called = True
        env._partially_observable = False
        env.__dict__.pop("sawyer_observation_space", None)
        env.max_path_length = sys.maxsize
        self._first_attributes[name] = step_attributes(env)
        self._first_layouts[name] = env.model.body_pos.copy(), env.model.site_pos.copy()
        self._envs[name] = env
        while len(self._envs) > _KEPT_ENVS:
            self._envs.popitem(last=False)[1].close()
        return env
