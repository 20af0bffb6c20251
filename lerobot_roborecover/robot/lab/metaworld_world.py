"""The lab's table as a Meta-World task: a Sawyer whose hand follows position targets."""

from __future__ import annotations

import cv2
import mujoco
import numpy as np
from metaworld import ALL_V3_ENVIRONMENTS

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.metaworld.simulator import MetaworldSimulator
from lerobot_roborecover.robot.lab.world import Truth
from lerobot_roborecover.scenario import Reset, ScenarioError, Task

_SUBSTEPS = 4
"""Simulator steps a control step: 20 of the latter a second."""
_GAIN = 0.15
_GRIPPER_PERCENT = 100.0
_AWAY_M = np.array([0.0, 0.0, -5.0])


class MetaworldWorld:
    """Joints are the hand's place in millimetres and the gripper's opening in per cent.

    Args:
        size: rows and columns of a picture.
    """

    joints = ("x", "y", "z", "gripper")
    units = {"x": "mm", "y": "mm", "z": "mm", "gripper": "percent"}  # noqa: RUF012
    limits = {"x": (-400.0, 400.0), "y": (300.0, 950.0), "z": (45.0, 400.0), "gripper": (0.0, 110.0)}  # noqa: RUF012
    cameras = ("front",)

    def __init__(self, size: int = 96):
        tasks = platform_named("metaworld").tasks()
        self.tasks = {task.name: task.instruction for task in tasks if task.name in ALL_V3_ENVIRONMENTS}
        self._simulator = _OpenSimulator(size)
        self._shift_px = np.zeros(2)

    def reset(self, task: str, seed: int) -> None:
        if task not in self.tasks:
            raise ScenarioError(f"--robot.task={task!r:.40}: Meta-World has no task of that name")
        self._simulator.reset(Task("metaworld", "metaworld", task, self.tasks[task], 500), Reset(seed=seed))

    def step(self, target: np.ndarray) -> None:
        """Moves towards a target: millimetres, and per cent of the gripper's opening."""
        for _ in range(_SUBSTEPS):
            gap_m = np.asarray(target[:3], float) / 1000 - self._simulator.low_dim()[:3]
            opening = _GRIPPER_PERCENT * self._simulator.low_dim()[3]
            grip = np.clip((opening - target[3]) / 10.0, -1.0, 1.0)
            # An action of 1 moves what pulls the hand by a centimetre; the hand follows with a lag.
            self._simulator.step(np.array([*np.clip(_GAIN * gap_m / 0.01, -1.0, 1.0), grip]))

    def positions(self) -> np.ndarray:
        """(4,) the hand's place in millimetres, and the gripper's opening in per cent."""
        numbers = self._simulator.low_dim()[:4]
        return numbers * [1000, 1000, 1000, _GRIPPER_PERCENT]

    def image(self, camera: str) -> np.ndarray:
        """(size, size, 3) uint8."""
        picture = self._simulator.render()
        if not self._shift_px.any():
            return picture
        matrix = np.array([[1.0, 0.0, self._shift_px[0]], [0.0, 1.0, self._shift_px[1]]])
        return cv2.warpAffine(picture, matrix, picture.shape[:2], borderMode=cv2.BORDER_REFLECT)

    def bump(self, camera: str, shift_px: tuple[float, float]) -> None:
        self._shift_px = np.array(shift_px, float)

    def succeeded(self) -> bool:
        """Meta-World's own predicate."""
        return self._simulator.succeeded()

    def truth(self) -> Truth:
        """Joint positions of everything that moves and is not the robot."""
        return self._simulator.object_joints()

    def boxes(self, camera: str) -> list[list[int]]:
        """None: the camera's geometry is Meta-World's own."""
        return []

    def clear(self) -> None:
        """Takes loose objects off the table; what is mounted stays."""
        truth = self.truth()
        for name, joints in truth.items():
            if len(joints) == 7:
                truth[name] = [*_AWAY_M, *joints[3:]]
        self._simulator.set_object_joints(truth)

    def place(self, truth: Truth, offset_m: np.ndarray, turn_rad: float) -> None:
        """Puts loose objects back with an error, and mounted ones off by the turn alone."""
        placed: Truth = {}
        for name, joints in truth.items():
            if len(joints) == 7:
                c, s = np.cos(turn_rad / 2), np.sin(turn_rad / 2)
                w, x, y, z = joints[3:]
                # A turn about the vertical, times the recorded rotation.
                quat = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)
                placed[name] = [joints[0] + offset_m[0], joints[1] + offset_m[1], joints[2], *quat]
            else:
                # A door or a drawer is set along its own axis: metres of a slide, radians of a hinge.
                placed[name] = [joint + float(offset_m[0]) for joint in joints]
        self._simulator.set_object_joints(placed)

    def distance_m(self, truth: Truth) -> float:
        """Largest over the objects; of mounted ones along their axis."""
        now = self.truth()
        gaps = [float(np.linalg.norm(np.subtract(now[n][:3], truth[n][:3]))) for n in truth]
        return max(gaps, default=0.0)

    def close(self) -> None:
        self._simulator.close()


class _OpenSimulator(MetaworldSimulator):
    """The simulator, with hands on the objects: a lab's operator moves them."""

    def __init__(self, size: int):
        super().__init__(size, size, render_quality="fast")

    def _addresses(self) -> dict[str, slice]:
        """Places in `qpos` of each tracked object's joints."""
        model = self._ready().model
        widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
        found = {}
        for name, body in self._tracked.items():
            joint = int(np.flatnonzero(model.jnt_bodyid == body)[0])
            start = int(model.jnt_qposadr[joint])
            found[name] = slice(start, start + widths.get(mujoco.mjtJoint(model.jnt_type[joint]), 1))
        return found

    def object_joints(self) -> Truth:
        qpos = self._ready().data.qpos
        return {name: qpos[where].tolist() for name, where in self._addresses().items()}

    def set_object_joints(self, joints: Truth) -> None:
        """Puts objects somewhere, at rest."""
        env = self._ready()
        for name, where in self._addresses().items():
            if name in joints:
                env.data.qpos[where] = joints[name]
        env.data.qvel[:] = 0.0
        mujoco.mj_forward(env.model, env.data)
        self._first, self._frame = None, None
