"""RoboTwin 2.0 behind the simulator protocol: RoboTwin's own task code on SAPIEN, replayed exactly."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.robotwin import stubs
from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
from lerobot_roborecover.platforms.robotwin.render import QUALITIES, no_rendering, rendering
from lerobot_roborecover.platforms.robotwin.task import RobotwinTask
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, ScenarioError, Task

CAMERA_NAMES = "head_camera,left_camera,right_camera"
"""LeRobot's cameras of RoboTwin: one over the table, one at each wrist."""
JOINT_WIDTH, EEF_WIDTH = 14, 16
ACTION_MODES = {"joint": JOINT_WIDTH, "ee": EEF_WIDTH}
OBS_TYPES = ("pixels", "pixels_agent_pos", "state")
_QUAT_SLICES = (slice(3, 7), slice(11, 15))
_QUAT_TOLERANCE = 0.1
"""How far from 1 the norm of a recorded quaternion may be: policies regress them, RoboTwin normalises."""


class RobotwinSimulator:
    """One RoboTwin task at a time.

    The suite of a task is RoboTwin's task configuration (`demo_clean`, `demo_randomized`), its reset a seed.
    Prefixes replay bit-identically; snapshots do not (`RobotwinTask.snapshot`), so replay is the rule.

    Args:
        robotwin_root: RoboTwin checkout; None takes `$ROBOTWIN_ROOT`.
        camera_names: comma-separated, or a list, of head_camera, left_camera, right_camera, front_camera.
        observation_height: rows of a frame, pixels; must be what RoboTwin's configuration renders.
        observation_width: columns of a frame.
        obs_type: `pixels`, `pixels_agent_pos` (both LeRobot's), or `state`, which needs no Vulkan device.
        render_quality: `rt` (RoboTwin's own), `default`, `minimal` or `trivial`.
        action_mode: `joint` (14 values) or `ee` (16): what a policy's actions are.
        endpose: observe the end-effector poses too, `endpose` (16,): `RobotwinTask.end_effectors`.

    Raises:
        SimulatorError: an option is out of range, or there is no checkout.
    """

    platform = "robotwin"
    control_hz = 25.0
    """LeRobot's figure for videos; an action takes 50 to 750 physics steps of 4 ms."""
    snapshot_is_exact = False

    def __init__(
        self,
        robotwin_root: str | None = None,
        camera_names: str | list[str] = CAMERA_NAMES,
        observation_height: int = 240,
        observation_width: int = 320,
        obs_type: str = "pixels_agent_pos",
        render_quality: str = "rt",
        action_mode: str = "joint",
        endpose: bool = False,
    ):
        for option, value, allowed in (
            ("obs_type", obs_type, OBS_TYPES),
            ("render_quality", render_quality, QUALITIES),
            ("action_mode", action_mode, tuple(ACTION_MODES)),
        ):
            if value not in allowed:
                raise SimulatorError(f"{option} {value!r} is not one of {', '.join(allowed)}")
        self.checkout = RobotwinCheckout(robotwin_root)
        names = camera_names.split(",") if isinstance(camera_names, str) else camera_names
        self._cameras = [name.strip() for name in names if name.strip()]
        self._size = (observation_height, observation_width)
        self._obs_type, self._quality, self._endpose = obs_type, render_quality, endpose
        self.action_dim = ACTION_MODES[action_mode]
        self._relative_to: np.ndarray | None = None
        self._task: RobotwinTask | None = None
        self._ready = False
        self._looked: Observation | None = None
        spaces: dict[str, gym.Space] = {}
        if obs_type != "state":
            image = gym.spaces.Box(0, 255, (*self._size, 3), np.uint8)
            spaces["pixels"] = gym.spaces.Dict(dict.fromkeys(self._cameras, image))
        if obs_type != "pixels":
            spaces["agent_pos"] = gym.spaces.Box(-np.inf, np.inf, (JOINT_WIDTH,), np.float32)
        if endpose:
            spaces["endpose"] = gym.spaces.Box(-np.inf, np.inf, (EEF_WIDTH,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)

    def reset(self, task: Task, reset: Reset) -> None:
        """Builds the scene of the task's seed, some 2,800 physics steps.

        Raises:
            ScenarioError: the checkout has no such task or configuration.
            SimulatorError: the reset has no seed, the seed's scene is unstable, or assets are missing.
        """
        check_task(self.checkout, task)
        if reset.seed is None:
            raise SimulatorError(
                f"task {task.name}: reset.seed is None; RoboTwin draws its scene from a seed, so the "
                "scenario's reset must name one (0 to 2^32 - 1)"
            )
        self._ready = False
        self._relative_to = self._looked = None
        if self._task is None or self._task.name != task.name:
            self._task = RobotwinTask(self.checkout, task.name)
        scene = no_rendering() if self._obs_type == "state" else rendering(self._quality)
        try:
            self._task.setup(task.suite, reset.seed, task.instruction, scene)
        except BaseException:
            self._task = None  # half set up
            raise
        self._ready = True

    def step(self, action: np.ndarray) -> None:
        """Executes one action: joint targets (14), or absolute end-effector poses (16) unless
        `set_control_mode` said relative ones. Never clipped.

        Raises:
            SimulatorError: not reset, or the action has another width, is not finite, holds a quaternion that
                is not one, or needs curobo where there is none.
        """
        task = self._require_reset()
        values = np.asarray(action, dtype=np.float64)
        if values.shape not in ((JOINT_WIDTH,), (EEF_WIDTH,)):
            raise SimulatorError(
                f"RoboTwin takes {JOINT_WIDTH} joint values or {EEF_WIDTH} end-effector values, got shape "
                f"{values.shape}"
            )
        if not np.isfinite(values).all():
            raise SimulatorError(f"a RoboTwin action must be finite, got {values}")
        if len(values) == EEF_WIDTH:
            values = self._end_effector_action(task, values)
        self._looked = None
        task.act(values, "qpos" if len(values) == JOINT_WIDTH else "ee")

    def observe(self) -> Observation:
        """LeRobot's raw observation: `pixels` by camera, and `agent_pos`, the (14,) float32 joint state.

        Raises:
            SimulatorError: not reset, or a camera does not exist or has another size.
        """
        task = self._require_reset()
        observation: Observation = {}
        if self._obs_type != "state":
            observation["pixels"] = {name: frame.copy() for name, frame in self._frames().items()}
        if self._obs_type != "pixels":
            observation["agent_pos"] = task.joint_state().astype(np.float32)
        if self._endpose:
            observation["endpose"] = task.end_effectors().astype(np.float32)
        return observation

    def render(self) -> np.ndarray:
        """(H, W, 3) uint8 of the first camera.

        Raises:
            SimulatorError: not reset, or `obs_type` is `state`, which renders nothing.
        """
        self._require_reset()
        if self._obs_type == "state":
            raise SimulatorError(
                "obs_type 'state' builds scenes that cannot be rendered; use pixels_agent_pos"
            )
        return next(iter(self._frames().values())).copy()

    def succeeded(self) -> bool:
        """Whether RoboTwin's predicate has held at a physics step since the reset; that ends the episode."""
        return bool(self._require_reset().task.eval_success)

    def set_control_mode(self, mode: str) -> None:
        """How end-effector actions are read until the next reset.

        Args:
            mode: `absolute` (RoboTwin's own, and recorded prefixes'), or `relative`: LeRobot's, deltas from
                the end-effector poses of this moment.
        """
        task = self._require_reset()
        if mode not in ("absolute", "relative"):
            raise SimulatorError(f"control mode {mode!r} is not one of absolute, relative")
        self._relative_to = task.end_effectors() if mode == "relative" else None

    def bodies(self) -> dict[str, Pose]:
        """Fingertip centres of both arms, and everything that can move but the robot."""
        return self._require_reset().bodies()

    def state_sha256(self) -> str:
        """SHA-256 of the physics state, the grippers, and the task's counters and flags."""
        return self._require_reset().state_sha256()

    def snapshot(self) -> bytes:
        """The state; continuing from it is not exact (see `snapshot_is_exact`)."""
        return self._require_reset().snapshot()

    def restore(self, snapshot: bytes) -> None:
        """Puts a snapshot of the same task and reset back."""
        self._looked = None
        self._require_reset().restore(snapshot)

    def fixtures(self) -> Mapping[str, Pose]:
        """None: the seed decides everything."""
        return {}

    def fingerprint(self) -> dict[str, str]:
        """Versions of SAPIEN and toppra, the robot, and, after a reset, the hashes of the task's code."""
        versions = {name: metadata.version(name) for name in ("sapien", "toppra")}
        return versions | (
            self.checkout.hashes(self._task.name) if self._task else self.checkout.robot.fingerprint
        )

    def close(self) -> None:
        self._task = None
        self._ready = False

    @property
    def robotwin_task(self) -> RobotwinTask:
        """The task underneath, for scripted experts that read privileged state."""
        return self._require_reset()

    def _frames(self) -> dict[str, np.ndarray]:
        """Pictures of the wanted cameras after the last step, rendered once."""
        if self._looked is None:
            cameras = self._require_reset().observation()["observation"]
            self._looked = {}
            for name in self._cameras:
                if name not in cameras or "rgb" not in cameras[name]:
                    raise SimulatorError(
                        f"RoboTwin's observation has no picture of {name!r}; it has {sorted(cameras)}"
                    )
                frame = np.asarray(cameras[name]["rgb"], dtype=np.uint8)[..., :3]
                if frame.shape[:2] != self._size:
                    raise SimulatorError(
                        f"{name} renders {frame.shape[0]}x{frame.shape[1]} in this task configuration, but "
                        f"observation_height and observation_width say {self._size[0]}x{self._size[1]}"
                    )
                self._looked[name] = frame
        return self._looked

    def _end_effector_action(self, task: RobotwinTask, values: np.ndarray) -> np.ndarray:
        """Checks an end-effector action, and makes a relative one absolute as LeRobot does."""
        if not stubs.has_curobo():
            raise SimulatorError(
                "end-effector actions (width 16) are planned by curobo, which is not installed and needs an "
                "NVIDIA GPU; install it, or use joint actions (width 14, --env.action_mode=joint)"
            )
        for part in _QUAT_SLICES:
            norm = float(np.linalg.norm(values[part]))
            if abs(norm - 1.0) > _QUAT_TOLERANCE:
                raise SimulatorError(
                    f"values {part.start} to {part.stop - 1} of an end-effector action are a quaternion; "
                    f"{values[part]} has norm {norm:.3f}, a rotation has norm 1"
                )
        return values if self._relative_to is None else _compose(values, self._relative_to)

    def _require_reset(self) -> RobotwinTask:
        if self._task is None or not self._ready:
            raise SimulatorError("the RoboTwin simulator was not reset; call reset(task, reset) first")
        return self._task


def check_task(checkout: RobotwinCheckout, task: Task) -> None:
    """Refuses a task, or a configuration, that the checkout does not have.

    Raises:
        ScenarioError: naming what there is.
    """
    if task.name not in checkout.step_limits:
        raise ScenarioError(
            f"RoboTwin at {checkout.root} has no task {task.name!r}; its tasks are "
            f"{', '.join(checkout.step_limits)}"
        )
    if task.suite not in checkout.task_configs:
        raise ScenarioError(
            f"RoboTwin task {task.name}: suite {task.suite!r} is not a task configuration of "
            f"{checkout.configs}; there are {', '.join(checkout.task_configs)}"
        )


def _compose(deltas: np.ndarray, start: np.ndarray) -> np.ndarray:
    """LeRobot's reading of a 16-vector of deltas (lerobot/envs/robotwin.py, `_add_init_eef_pose`):
    translations are added, rotations composed, both read in scipy's order, grippers taken as they are."""
    from scipy.spatial.transform import Rotation

    out = deltas.copy()
    for arm in (0, 8):
        p, q = slice(arm, arm + 3), slice(arm + 3, arm + 7)
        out[p] = start[p] + deltas[p]
        turned = Rotation.from_quat(start[q]) * Rotation.from_quat(deltas[q])
        out[q] = turned.as_quat()  # ty: ignore[missing-union-attribute] - NotImplemented is no result
    return out


__all__ = ["CAMERA_NAMES", "RobotwinSimulator", "check_task"]
