"""What a policy sees of LIBERO: robosuite's observation timing, LeRobot's layout, and lazy rendering."""

from __future__ import annotations

import atexit

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.assets import cache_folder
from lerobot_roborecover.platforms.libero.fast import light_copy, without_reflections
from lerobot_roborecover.platforms.libero.goal_state import GoalState
from lerobot_roborecover.platforms.libero.task import LiberoTask
from lerobot_roborecover.platforms.simulator import Observation, SimulatorError

_SEEN = (
    "qpos",
    "qvel",
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "subtree_com",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "cam_xpos",
    "cam_xmat",
    "light_xpos",
    "light_xdir",
)
"""What observations and pictures read of `MjData`. Within a control step the kinematics are those of before
the last physics step, and qpos and qvel those of after it: so all are copied, none computed."""


class ObservableClock:
    """The sampling clock of robosuite's observables (robosuite/utils/observables.py, `Observable.update`).

    A step's observation is not the state at its end: each observable samples once per control period, in the
    first physics step after its own clock wraps, and that clock starts two physics steps ahead because a
    reset forces two updates. Float additions are made as robosuite makes them, so that both wrap together.

    Args:
        timestep_s: physics step.
        period_s: control period.
    """

    def __init__(self, timestep_s: float, period_s: float):
        self._timestep_s, self._period_s = timestep_s, period_s
        self.reset()

    def reset(self) -> None:
        """As after `env.reset()` and `set_init_state()`."""
        self.since_sample_s = 0.0 + self._timestep_s + self._timestep_s
        self.sampled = True

    def tick(self) -> bool:
        """Advances by one physics step; whether the observables sample now."""
        self.since_sample_s += self._timestep_s
        samples = not self.sampled and self._period_s >= self.since_sample_s
        self.sampled = self.sampled or samples
        if self.since_sample_s >= self._period_s:
            samples = samples or not self.sampled
            self.since_sample_s %= self._period_s
            self.sampled = False
        return samples

    @property
    def state(self) -> np.ndarray:
        """(2,) float64, for a snapshot."""
        return np.array([self.since_sample_s, float(self.sampled)])

    @state.setter
    def state(self, value: np.ndarray) -> None:
        self.since_sample_s, self.sampled = float(value[0]), bool(value[1])


class LiberoView:
    """The observation of one task at the last sampling instant, drawn only when asked for.

    Args:
        task: what is looked at; its simulation is never touched.
        height: of the pictures, pixels.
        width: of the pictures, pixels.
        fast: draws less, see `fast.py`; otherwise pictures are LeRobot's, bit for bit.
    """

    def __init__(self, task: LiberoTask, height: int, width: int, fast: bool = False):
        self._task, self._height, self._width, self._fast = task, height, width, fast
        self._renderer: mujoco.Renderer | None = None
        self._model: mujoco.MjModel | None = None
        self._goal_state: GoalState | None = None
        self._frames: dict[str, np.ndarray] = {}

    def sample(self) -> None:
        """Takes the simulation as it is now for what is seen."""
        task = self._task
        if self._model is not task.model:  # a hard reset compiled a new one
            self.close()
            self._model, self._goal_state = task.model, None
            self._scratch = mujoco.MjData(task.model)
        for name in _SEEN:
            getattr(self._scratch, name)[:] = getattr(task.data, name)
        self._site_rgba = task.model.site_rgba.copy()
        self._frames.clear()

    def robot_state(self) -> Observation:
        """LeRobot's `robot_state`: metres, radians, quaternion xyzw; all float64."""
        data, robot = self._scratch, self._task.robot
        hand = self._task.env.sim.model.body_name2id(robot.robot_model.eef_name)
        return {
            "eef": {
                "pos": data.site_xpos[robot.eef_site_id].copy(),
                "quat": data.xquat[hand][[1, 2, 3, 0]],
                "mat": np.array(robot.controller.ee_ori_mat),
            },
            "gripper": {
                "qpos": data.qpos[robot._ref_gripper_joint_pos_indexes],
                "qvel": data.qvel[robot._ref_gripper_joint_vel_indexes],
            },
            "joints": {
                "pos": data.qpos[robot._ref_joint_pos_indexes],
                "vel": data.qvel[robot._ref_joint_vel_indexes],
            },
        }

    def environment_state(self) -> np.ndarray:
        """See `goal_state.ENVIRONMENT_STATE`; (77,) float64."""
        if self._goal_state is None:
            self._goal_state = GoalState(self._task)
        return self._goal_state.read(self._scratch)

    def frame(self, camera: str) -> np.ndarray:
        """(H, W, 3) uint8 in robosuite's raw orientation (bottom row first); the caller must not write to it.

        Raises:
            SimulatorError: there is no such camera, or no OpenGL context can be made.
        """
        if camera not in self._frames:
            renderer = self._renderer or self._make_renderer()
            model = renderer.model
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera) < 0:
                cameras = [model.camera(i).name for i in range(model.ncam)]
                raise SimulatorError(f"LIBERO has no camera {camera!r}; there are {', '.join(cameras)}")
            # Indicator sites (a glowing stove) change at the end of a step, after the sampling instant.
            site_rgba = model.site_rgba.copy()
            model.site_rgba[:] = self._site_rgba
            try:
                renderer.update_scene(self._scratch, camera, self._options)
                self._frames[camera] = np.ascontiguousarray(renderer.render()[::-1])
            finally:
                model.site_rgba[:] = site_rgba
        return self._frames[camera]

    def close(self) -> None:
        """Frees the OpenGL context, if one was made."""
        if self._renderer is not None:
            atexit.unregister(self.close)
            self._renderer.close()
            self._renderer = None
        self._frames.clear()

    def _make_renderer(self) -> mujoco.Renderer:
        model = self._task.model
        if self._fast:
            model = light_copy(model, max(self._height, self._width), cache_folder() / "meshes")
        size = model.vis.global_
        size.offwidth, size.offheight = max(size.offwidth, self._width), max(size.offheight, self._height)
        try:
            self._renderer = mujoco.Renderer(model, self._height, self._width)
        except Exception as err:  # each OpenGL backend raises its own kinds
            raise SimulatorError(
                f"no OpenGL context for rendering: {err}. On a machine without display set MUJOCO_GL=egl "
                "(Debian: libegl1 libgl1-mesa-dri) or MUJOCO_GL=osmesa (libosmesa6)"
            ) from err
        if self._fast:
            without_reflections(self._renderer.scene)
        atexit.register(self.close)  # a context that outlives EGL complains on standard error
        self._options = mujoco.MjvOption()
        self._options.geomgroup[0] = 0  # collision geoms
        self._options.geomgroup[1] = 1  # visual geoms
        return self._renderer
