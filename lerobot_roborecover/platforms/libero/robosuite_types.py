"""What this package uses of robosuite 1.4 and hf-libero, which say nothing of their types.

Their own classes begin most attributes as None and fill them at the first reset; here they are as after it.
For the type checker alone: nothing of this is looked at when the code runs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

import mujoco
import numpy as np


class _Model(Protocol):
    _model: mujoco.MjModel

    def body_name2id(self, name: str) -> int: ...
    def joint_name2id(self, name: str) -> int: ...
    def site_name2id(self, name: str) -> int: ...


class _Data(Protocol):
    _data: mujoco.MjData

    def get_site_xpos(self, name: str) -> np.ndarray: ...


class Sim(Protocol):
    """robosuite's `MjSim`: MuJoCo's model and data in their own wrappers."""

    model: _Model
    data: _Data
    forward: Callable[[], None]

    def set_state_from_flattened(self, state: np.ndarray) -> None:
        """Puts back time, qpos and qvel."""
        ...


class MujocoModel(Protocol):
    """robosuite's base of objects, fixtures, robots and grippers."""

    contact_geoms: Sequence[str]


class _Gripper(Protocol):
    current_action: np.ndarray
    """(2,) float64; (1,) or (2,) after a step."""
    important_geoms: Mapping[str, Sequence[str]]
    speed: float


class OperationalSpaceController(Protocol):
    """robosuite's `OperationalSpaceController`."""

    J_full: np.ndarray
    J_ori: np.ndarray
    J_pos: np.ndarray
    ee_ori_mat: np.ndarray
    ee_ori_vel: np.ndarray
    ee_pos: np.ndarray
    ee_pos_vel: np.ndarray
    eef_name: str
    goal_ori: np.ndarray
    goal_pos: np.ndarray
    impedance_mode: str
    initial_joint: np.ndarray
    interpolator_ori: object
    interpolator_pos: object
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    kd: np.ndarray
    kp: np.ndarray
    mass_matrix: np.ndarray
    new_update: bool
    position_limits: Sequence[np.ndarray] | None
    """Lowest and highest corner, (3,) each."""
    qpos_index: Sequence[int]
    qvel_index: Sequence[int]
    torques: np.ndarray
    uncoupling: bool
    use_delta: bool
    use_ori: bool

    def set_goal(self, action: np.ndarray) -> None:
        """Takes a (6,) command."""
        ...

    def scale_action(self, action: np.ndarray) -> np.ndarray:
        """(6,) metres and radians of a (6,) command, which it clips."""
        ...


class _RobotModel(Protocol):
    eef_name: str
    root_body: str


class SingleArm(Protocol):
    """robosuite's `SingleArm`."""

    controller: OperationalSpaceController
    eef_site_id: int
    gripper: _Gripper
    robot_model: _RobotModel
    torques: np.ndarray
    _ref_gripper_joint_pos_indexes: list[int]
    _ref_gripper_joint_vel_indexes: list[int]
    _ref_joint_actuator_indexes: list[int]
    _ref_joint_gripper_actuator_indexes: list[int]
    _ref_joint_indexes: list[int]
    _ref_joint_pos_indexes: list[int]
    _ref_joint_vel_indexes: list[int]


class _Item(Protocol):
    """An object or a fixture."""

    joints: Sequence[str]
    name: str
    object_properties: Mapping[str, Any]
    root_body: str


class _Region(Protocol):
    """A site of an object or of a fixture, where other objects belong."""

    joints: Sequence[str] | None
    parent_name: str


class _Sampler(Protocol):
    mujoco_objects: Collection[_Item]


class _Placement(Protocol):
    samplers: Mapping[str, _Sampler]


class LiberoEnv(Protocol):
    """hf-libero's `BDDLBaseDomain`, below its `ControlEnv`."""

    check_contact: Callable[..., bool]
    control_timestep: float
    model_timestep: float
    fixtures_dict: Mapping[str, _Item]
    hard_reset: bool
    obj_body_id: Mapping[str, int]
    object_sites_dict: Mapping[str, _Region]
    objects_dict: Mapping[str, _Item]
    parsed_problem: Mapping[str, Any]
    """The BDDL file, as LIBERO parsed it."""
    placement_initializer: _Placement
    robots: Sequence[SingleArm]
    sim: Sim
    workspace_offset: Sequence[float]
    """(3,) metres."""
    _initialize_sim: Callable[[str | None], None]

    def close(self) -> None: ...

    def get_object(self, name: str) -> _Item: ...

    def reset(self) -> object:
        """Draws the placement anew."""
        ...

    def _check_grasp(self, gripper: _Gripper, item: _Item) -> bool: ...
    def _check_success(self) -> bool: ...
    def _eval_predicate(self, state: Sequence[str]) -> bool: ...
    def _post_process(self) -> None: ...
    def _pre_action(self, action: np.ndarray, policy_step: bool) -> None: ...
