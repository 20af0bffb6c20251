"""One LIBERO task, built once: exact resets, physics-only steps and complete snapshots of hf-libero's own.

What is not obvious about robosuite and LIBERO, and is handled here:

- `ControlEnv.reset` swallows every exception in an endless loop; the environment below it is reset directly.
- Fixture poses are drawn from numpy's global generator at every reset and are not in the stored init states.
- A soft reset keeps the gripper's last action and the colours of indicator sites.
- The OSC controller caches kinematics and keeps its orientation goal while no rotation is commanded, so both
  belong to the state.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.assets import package_root
from lerobot_roborecover.platforms.libero.contacts import ContactCheck
from lerobot_roborecover.platforms.libero.init_states import read_init_states
from lerobot_roborecover.platforms.libero.marks import PlaceMarks
from lerobot_roborecover.platforms.libero.osc import OscControl, osc_control
from lerobot_roborecover.platforms.libero.reach import ArmReach
from lerobot_roborecover.platforms.limits import Workspace
from lerobot_roborecover.platforms.mujoco_state import (
    body_pose,
    hash_arrays,
    load_state,
    movable_bodies,
    pack_arrays,
    save_state,
    site_pose,
    unpack_arrays,
)
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Pose

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import LiberoEnv, SingleArm

_ENDLESS = 2**31 - 1
"""Horizon given to robosuite, which otherwise ends an episode after 1,000 steps whatever its outcome."""
_PLACEMENT_ATTEMPTS = 100
_REACH_M = 0.855
"""Of a Franka Emika Panda (its data sheet)."""
_CONTROLLER_CACHE = (
    "goal_pos",
    "goal_ori",
    "ee_pos",
    "ee_ori_mat",
    "ee_pos_vel",
    "ee_ori_vel",
    "joint_pos",
    "joint_vel",
    "J_pos",
    "J_ori",
    "J_full",
    "mass_matrix",
)


@dataclass(frozen=True)
class FirstReset:
    """What is left to chance by the first reset of a fresh environment after a seed."""

    fixtures: Mapping[str, Pose]
    """Poses drawn."""
    warmstart: np.ndarray
    """(nv,) float64: where the constraint solver of the init state's forward pass starts. It depends on where
    the movable objects were drawn, and on it depend the last bits of every state that follows."""


class LiberoTask:
    """hf-libero's environment of one task, without any OpenGL context.

    Args:
        suite: e.g. `libero_goal`.
        name: the task's name in the suite.
        control_hz: control steps per simulated second.
        first_resets: by seed; filled here, and shared by all environments of the task.

    Raises:
        SimulatorError: the package lacks the task's files.
    """

    def __init__(self, suite: str, name: str, control_hz: float, first_resets: dict[int, FirstReset]):
        # robosuite warns at every import that an optional file of its own was not made.
        logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
        from libero.libero.envs.env_wrapper import ControlEnv

        bddl = package_root() / "bddl_files" / suite / f"{name}.bddl"
        if not bddl.is_file():
            raise SimulatorError(f"hf-libero has no {bddl}; install hf-libero==0.1.4")
        self.init_states = read_init_states(suite, name)
        with _numpy_random(None):
            self.env: LiberoEnv = ControlEnv(
                bddl_file_name=str(bddl),
                use_camera_obs=False,
                has_offscreen_renderer=False,
                has_renderer=False,
                control_freq=control_hz,
                horizon=_ENDLESS,
                ignore_done=True,
                hard_reset=False,
            ).env
        self.substeps = int(self.env.control_timestep / self.env.model_timestep)
        self._first_resets = first_resets
        self._used = False
        self._site_rgba: np.ndarray | None = None
        self._osc: OscControl | None = None
        self.use_shortcuts(True)

    @property
    def model(self) -> mujoco.MjModel:
        return self.env.sim.model._model

    @property
    def data(self) -> mujoco.MjData:
        return self.env.sim.data._data

    @property
    def robot(self) -> SingleArm:
        """robosuite's single-arm robot."""
        return self.env.robots[0]

    def use_shortcuts(self, on: bool) -> None:
        """Whether control and contacts go by `osc.py` and `contacts.py`, as they do from the start, or by
        robosuite's own code, which gives the same bits later. For comparisons."""
        self._shortcuts = on
        if on:
            self.env.check_contact = ContactCheck(self.env)
        else:
            vars(self.env).pop("check_contact", None)

    def can_reset(self, seed: int | None) -> bool:
        """Whether `reset` can take this seed; if not, it takes an environment that was never reset."""
        return seed is None or seed in self._first_resets or not self._used

    @cached_property
    def fixture_bodies(self) -> dict[str, int]:
        """Ids by name of the bodies whose pose LIBERO draws at every reset."""
        samplers = self.env.placement_initializer.samplers.values()
        objects = [
            o for sampler in samplers for o in sampler.mujoco_objects if o.name in self.env.fixtures_dict
        ]
        return {o.root_body: self.env.sim.model.body_name2id(o.root_body) for o in objects}

    @cached_property
    def movable_bodies(self) -> dict[str, int]:
        """Ids by name of what can move, the robot left out."""
        root = self.env.sim.model.body_name2id(self.robot.robot_model.root_body)
        return movable_bodies(self.model, exclude=[root])

    def reset(self, seed: int | None, init_state: np.ndarray, fixtures: Mapping[str, Pose]) -> None:
        """Puts the task in a stored init state, with the fixtures where they were recorded.

        Args:
            seed: of LIBERO's draws, as `can_reset` allows; None only with fixtures.
            init_state: one row of `init_states`.
            fixtures: pose of every body of `fixture_bodies`; empty for what the seed draws.

        Raises:
            SimulatorError: the fixtures are not this task's, or LIBERO finds no valid placement.
        """
        if fixtures and set(fixtures) != set(self.fixture_bodies):
            raise SimulatorError(
                f"the reset gives poses for the fixtures {sorted(fixtures)}, the task has "
                f"{sorted(self.fixture_bodies)}; record the scenario's reset again"
            )
        if self._site_rgba is not None:
            self.model.site_rgba[:] = self._site_rgba
        with _numpy_random(seed):
            if seed is None or seed in self._first_resets:
                self._reset_env()
            else:
                self._first_resets[seed] = self._first_reset()
        self._used = True
        self._site_rgba = self.model.site_rgba.copy()
        self.robot.gripper.current_action = np.zeros(2)
        drawn = None if seed is None else self._first_resets[seed]
        poses = fixtures if drawn is None else fixtures or drawn.fixtures
        for name, pose in poses.items():
            body = self.fixture_bodies[name]
            x, y, z, w = pose.quat_xyzw
            self.model.body_pos[body] = pose.position_m
            self.model.body_quat[body] = (w, x, y, z)
        self.data.qacc_warmstart[:] = drawn.warmstart if drawn else 0.0
        # The rest is ControlEnv.set_init_state without its observation.
        self.env.sim.set_state_from_flattened(init_state)
        self.env.sim.forward()
        self.env._check_success()
        self.env._post_process()

    def step(self, action: np.ndarray, after_substep: Callable[[], None]) -> None:
        """One control step, bit-identical to robosuite's `env.step` but for its observations and reward.

        Args:
            action: (7,), as recorded or as the policy gave it; robosuite clips what it clips.
            after_substep: called after each physics step, where robosuite updates its observables.

        Raises:
            SimulatorError: the physics became unstable.
        """
        model, data, sim = self.model, self.data, self.env.sim
        control = self._controlled() or self.env._pre_action
        # robosuite computes the forward dynamics three times per physics step: before the controller, in it,
        # and in mj_step. Each constraint solve starts from the one before, so the same bits need all three.
        # Positions, velocities and sensors, which do not change in between, are computed once.
        sim.forward = partial(mujoco.mj_forwardSkip, model, data, mujoco.mjtStage.mjSTAGE_VEL, 1)
        try:
            for substep in range(self.substeps):
                mujoco.mj_step1(model, data)
                sim.forward()
                control(action, substep == 0)
                mujoco.mj_step2(model, data)
                after_substep()
        finally:
            del sim.forward
        self.env._post_process()
        if unstable := [w.name for w in _UNSTABLE if data.warning[w].number]:
            raise SimulatorError(f"the physics became unstable ({', '.join(unstable)}); action {action!r}")

    def bodies(self) -> dict[str, Pose]:
        """World poses of the grip site (`eef`), of everything that can move, and of the goal's marks."""
        poses = {"eef": site_pose(self.data, self.robot.eef_site_id)}
        poses |= {name: body_pose(self.data, body) for name, body in self.movable_bodies.items()}
        return poses | self.place_marks.poses()

    @cached_property
    def place_marks(self) -> PlaceMarks:
        """Marks of the goal's places."""
        return PlaceMarks(self.env, self.model, self.data)

    @cached_property
    def reach(self) -> ArmReach:
        """Inverse kinematics of the arm."""
        return ArmReach(self.model, np.array(self.robot._ref_joint_indexes), self.robot.eef_site_id)

    def reaches(self, action: np.ndarray) -> bool:
        """Whether the arm can go where a relative command would send it."""
        controller = self.robot.controller
        goal = (
            site_pose(self.data, self.robot.eef_site_id).position_m + controller.scale_action(action[:6])[:3]
        )
        if controller.position_limits is not None:
            low, high = controller.position_limits
            if (goal < low).any() or (goal > high).any():
                return False
        return self.reach.reaches(self.data.qpos, goal)

    def workspace(self) -> Workspace:
        """The table's area (LIBERO's problems name its size `..._full_size` and its top `workspace_offset`),
        from 5 cm below its top, which is where a bent finger may be, to 1 m above. On the floor, where there
        is no table, what the Panda's 0.855 m reach from its base."""
        x, y, z = self.env.workspace_offset
        sizes = [v for k, v in vars(self.env).items() if k.endswith("table_full_size")]
        if sizes and z > 0.1:
            half = np.array(sizes[-1][:2]) / 2
            low, high = np.array([x, y]) - half, np.array([x, y]) + half
        else:
            base = self.data.body(self.robot.robot_model.root_body).xpos[:2]
            low, high = base - _REACH_M, base + _REACH_M
        (low_x, low_y), (high_x, high_y) = map(float, low), map(float, high)
        return Workspace((low_x, low_y, z - 0.05), (high_x, high_y, z + 1.0), float(z))

    def fixtures(self) -> dict[str, Pose]:
        """Poses of the fixtures that LIBERO draws at reset, as the model holds them."""
        poses = {}
        for name, body in self.fixture_bodies.items():
            w, x, y, z = self.model.body_quat[body]
            poses[name] = Pose(tuple(self.model.body_pos[body]), (x, y, z, w))
        return poses

    def state_sha256(self) -> str:
        """Hash of everything that the continuation depends on."""
        model = self.model
        gripper = np.broadcast_to(self.robot.gripper.current_action, 2)
        return hash_arrays(
            save_state(model, self.data),
            gripper,
            self.robot.controller.goal_ori,
            model.body_pos,
            model.body_quat,
        )

    def snapshot(self, **extra: np.ndarray) -> bytes:
        """The complete state, with arrays of the caller's own."""
        controller = self.robot.controller
        return pack_arrays(
            **extra,
            state=save_state(self.model, self.data),
            gripper=np.broadcast_to(self.robot.gripper.current_action, 2),
            body_pos=self.model.body_pos,
            body_quat=self.model.body_quat,
            site_rgba=self.model.site_rgba,
            new_update=np.array(controller.new_update),
            **{f"controller_{name}": getattr(controller, name) for name in _CONTROLLER_CACHE},
        )

    def restore(self, snapshot: bytes) -> dict[str, np.ndarray]:
        """Puts a snapshot of this task back and returns all its arrays.

        Raises:
            SimulatorError: it is not a snapshot of this task.
        """
        arrays = unpack_arrays(snapshot)
        try:
            load_state(self.model, self.data, arrays["state"])
            self.model.body_pos[:] = arrays["body_pos"]
            self.model.body_quat[:] = arrays["body_quat"]
            self.model.site_rgba[:] = arrays["site_rgba"]
            self.robot.gripper.current_action = arrays["gripper"].copy()
            controller = self.robot.controller
            controller.new_update = bool(arrays["new_update"])
            for name in _CONTROLLER_CACHE:
                # The memory layout is part of the state: BLAS rounds differently in row and in column order.
                setattr(controller, name, arrays[f"controller_{name}"].copy(order="K"))
        except (KeyError, ValueError) as err:
            raise SimulatorError(f"the snapshot is not of this task: {err}") from err
        return arrays

    def close(self) -> None:
        self._osc = None
        self.env.close()

    def _controlled(self) -> OscControl | None:
        if not self._shortcuts:
            return None
        if self._osc is None or not self._osc.applies:
            self._osc = osc_control(self.env)
        return self._osc

    def _first_reset(self) -> FirstReset:
        """The first reset of a fresh environment, as LIBERO does it.

        It reloads the model, which decides how many random numbers are drawn (every reload adds to
        `object_property_initializers`), and makes an OpenGL context with a forward pass: here the pass alone.
        """
        if self._used:
            raise RuntimeError("the environment was reset before; ask can_reset")
        initialize = self.env._initialize_sim

        def initialize_and_forward(xml_string: str | None = None) -> None:
            initialize(xml_string)
            self.env.sim.forward()

        self.env._initialize_sim = initialize_and_forward
        self.env.hard_reset = True
        try:
            self._reset_env()
        finally:
            self.env.hard_reset = False
            del self.env._initialize_sim
        self._osc = None  # as what follows, of the model before
        for name in ("fixture_bodies", "movable_bodies", "place_marks", "reach"):
            self.__dict__.pop(name, None)
        return FirstReset(self.fixtures(), self.data.qacc_warmstart.copy())

    def _reset_env(self) -> None:
        from robosuite.utils.errors import RandomizationError

        for _ in range(_PLACEMENT_ATTEMPTS):
            try:
                self.env.reset()
            except RandomizationError:  # LIBERO draws again
                continue
            return
        raise SimulatorError(
            f"LIBERO found no valid placement in {_PLACEMENT_ATTEMPTS} attempts; use another seed"
        )


_UNSTABLE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
"""Warnings after which MuJoCo resets the simulation by itself."""


@contextmanager
def _numpy_random(seed: int | None) -> Generator[None]:
    """numpy's global generator, which LIBERO draws from, seeded inside and as it was outside."""
    state = np.random.get_state()
    if seed is not None:
        np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)
