"""robosuite's operational-space control of LIBERO's Panda, bit for bit, without its look-ups by name.

robosuite runs the controller before each of the 25 physics steps of a control step and spends more time on
finding out what it controls than on controlling it. Here that is found out once per controller. What is done
with numbers, the order, the compiled functions, and the memory layouts of what these are given are those of
robosuite 1.4.0 (osc.py and base_controller.py of controllers, single_arm.py and manipulator.py of robots,
panda_gripper.py): BLAS rounds otherwise in row than in column order.

What is left out: robosuite's `recent_*` buffers of the robot, which neither LIBERO nor its snapshots look at.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import (
        LiberoEnv,
        OperationalSpaceController,
        SingleArm,
    )

_ROBOSUITE = "1.4.0"
"""Whose operations these are."""


def osc_control(env: LiberoEnv) -> OscControl | None:
    """The control of the environment's robot; None if it is not what LIBERO's own tasks have.

    Args:
        env: after a reset, which makes the controller.
    """
    if len(env.robots) != 1 or not _known(env.robots[0]):
        return None
    (robot,) = env.robots
    controller = robot.controller
    indexes = (
        controller.qpos_index,
        controller.qvel_index,
        robot._ref_joint_actuator_indexes,
        robot._ref_joint_gripper_actuator_indexes,
    )
    spans = [span for span in map(_span, indexes) if span is not None]
    return OscControl(env, *spans) if len(spans) == len(indexes) else None


class OscControl:
    """In place of robosuite's `env._pre_action`.

    After every call, controller, robot, gripper and `data.ctrl` are as after robosuite's, the buffers apart.

    Args:
        env: with the robot that `osc_control` accepts.
        qpos: of the arm's joints.
        qvel: of the arm's joints.
        motors: the arm's actuators.
        fingers: the gripper's actuators.
    """

    def __init__(self, env: LiberoEnv, qpos: slice, qvel: slice, motors: slice, fingers: slice):
        from robosuite.utils.control_utils import nullspace_torques, opspace_matrices, orientation_error

        self._nullspace_torques = nullspace_torques
        self._opspace_matrices = opspace_matrices
        self._orientation_error = orientation_error
        self._env, self._sim = env, env.sim
        (self._robot,) = env.robots
        self._controller = self._robot.controller
        self._gripper = self._robot.gripper
        model, data = env.sim.model._model, env.sim.data._data
        self._model, self._data = model, data
        self._site = env.sim.model.site_name2id(self._controller.eef_name)
        # MuJoCo's arrays keep their places as long as the model does: these are views.
        self._site_pos = data.site_xpos[self._site]
        self._site_mat = data.site_xmat[self._site].reshape(3, 3)
        self._all_qvel = data.qvel
        self._qpos, self._qvel, self._bias = data.qpos[qpos], data.qvel[qvel], data.qfrc_bias[qvel]
        self._packed_mass = data.qM
        self._motors, self._fingers = data.ctrl[motors], data.ctrl[fingers]
        self._motor_range = model.actuator_ctrlrange[motors]
        self._finger_range = model.actuator_ctrlrange[fingers]
        self._full_mass = np.zeros((model.nv, model.nv))
        self._mass = self._full_mass[qvel, qvel]
        self._full_jac_pos, self._full_jac_ori = np.zeros((2, 3, model.nv))
        self._jac_pos, self._jac_ori = self._full_jac_pos[:, qvel], self._full_jac_ori[:, qvel]
        # Position and orientation, one behind the other, as a whole and by halves.
        self._error, self._error_pos, self._error_ori = _halves()
        self._speed, self._speed_pos, self._speed_ori = _halves()
        self._wanted, self._wanted_pos, self._wanted_ori = _halves()
        self._wrench, self._wrench_pos, self._wrench_ori = _halves()

    @property
    def applies(self) -> bool:
        """Whether the robot still has this controller, with these options; robosuite makes another at every
        reset."""
        return self._env.robots[0].controller is self._controller and _plain(self._controller)

    def __call__(self, action: np.ndarray, policy_step: bool) -> None:
        """Sets `data.ctrl` for the next physics step.

        Args:
            action: (7,).
            policy_step: whether the action is a new one.
        """
        controller, robot = self._controller, self._robot
        if controller.new_update:
            self._update()
        if policy_step:
            self._begin(action)
        np.subtract(self._goal_pos, controller.ee_pos, out=self._error_pos)
        self._error_ori[:] = self._orientation_error(self._goal_ori, controller.ee_ori_mat)
        self._speed_pos[:], self._speed_ori[:] = controller.ee_pos_vel, controller.ee_ori_vel
        np.subtract(self._error * controller.kp, self._speed * controller.kd, out=self._wanted)
        mass, jac = controller.mass_matrix, controller.J_full
        _, lambda_pos, lambda_ori, nullspace = self._opspace_matrices(
            mass, jac, controller.J_pos, controller.J_ori
        )
        np.dot(lambda_pos, self._wanted_pos, out=self._wrench_pos)
        np.dot(lambda_ori, self._wanted_ori, out=self._wrench_ori)
        torques = np.dot(jac.T, self._wrench)
        torques += self._bias
        torques += self._nullspace_torques(
            mass, nullspace, controller.initial_joint, controller.joint_pos, controller.joint_vel
        )
        controller.torques = torques
        controller.new_update = True
        robot.torques = _clip(torques, *self._motor_limits)
        self._gripper.current_action = grip = _clip(self._gripper.current_action + self._grip_step, -1.0, 1.0)
        self._fingers[:] = self._grip_bias + self._grip_weight * grip
        self._motors[:] = robot.torques

    def _update(self) -> None:
        """robosuite's `Controller.update`."""
        self._sim.forward()
        controller = self._controller
        controller.ee_pos, controller.ee_ori_mat = self._site_pos.copy(), self._site_mat.copy()
        mujoco.mj_jacSite(self._model, self._data, self._full_jac_pos, self._full_jac_ori, self._site)
        controller.ee_pos_vel = np.dot(self._full_jac_pos, self._all_qvel)
        controller.ee_ori_vel = np.dot(self._full_jac_ori, self._all_qvel)
        controller.joint_pos, controller.joint_vel = self._qpos.copy(), self._qvel.copy()
        # Indexing with lists, as robosuite does, gives columns that lie together.
        controller.J_full = jac = np.empty((6, len(self._qvel)), order="F")
        jac[:3], jac[3:] = self._jac_pos, self._jac_ori
        controller.J_pos, controller.J_ori = self._jac_pos.copy("F"), self._jac_ori.copy("F")
        mujoco.mj_fullM(self._model, self._full_mass, self._packed_mass)
        controller.mass_matrix = self._mass.copy("F")
        controller.new_update = False

    def _begin(self, action: np.ndarray) -> None:
        """What stays as it is during a control step."""
        controller = self._controller
        controller.set_goal(action[:6])
        self._goal_pos, self._goal_ori = np.array(controller.goal_pos), np.array(controller.goal_ori)
        self._motor_limits = self._motor_range.T.copy()
        low, high = self._finger_range.T
        self._grip_bias, self._grip_weight = 0.5 * (high + low), 0.5 * (high - low)
        self._grip_step = np.array([-1.0, 1.0]) * self._gripper.speed * np.sign(action[6:])


def _halves() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    whole = np.zeros(6)
    return whole, whole[:3], whole[3:]


def _known(robot: SingleArm) -> bool:
    from robosuite.controllers.osc import OperationalSpaceController
    from robosuite.models.grippers.panda_gripper import PandaGripper
    from robosuite.robots.single_arm import SingleArm

    types = (type(robot), type(robot.controller), type(robot.gripper))
    expected = (SingleArm, OperationalSpaceController, PandaGripper)
    return types == expected and _plain(robot.controller) and _version() == _ROBOSUITE


@cache
def _version() -> str:
    return metadata.version("robosuite")


def _plain(controller: OperationalSpaceController) -> bool:
    return (
        controller.impedance_mode == "fixed"
        and controller.interpolator_pos is None
        and controller.interpolator_ori is None
        and controller.uncoupling
        and controller.use_ori
    )


def _clip(values: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """`np.clip`, without its checks of what it was given."""
    return np.minimum(np.maximum(values, low), high)


def _span(indexes: Sequence[int]) -> slice | None:
    """The slice of these indexes, if they follow each other."""
    first, last = indexes[0], indexes[-1] + 1
    return slice(first, last) if list(indexes) == list(range(first, last)) else None
