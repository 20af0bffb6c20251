"""What LIBERO's scripted controller knows: geometry, grasps and goals, from privileged simulator state."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.joints import FixtureJoint
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.mujoco_state import subtree

_ARM_M, _WRIST_M = 0.765, 0.21
"""From the Panda's shoulder to its wrist when it is nearly stretched out; thence to the fingertips."""
_STRAIGHT_RAD = -0.15
"""The Panda's elbow; its limit is -0.07."""
_BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_COLLISION_GROUP = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


@dataclass(frozen=True)
class Goal:
    """One predicate of a task's goal."""

    predicate: tuple[str, ...]
    """As LIBERO parsed it."""
    item: str
    """Object to be moved; of a predicate about a joint, the fixture or the drawer."""
    region: str = ""
    """Object or region where it belongs."""


class LiberoScene:
    """The scene of the task that a simulator was last reset to; made anew after every reset.

    Args:
        simulator: after `reset`.
    """

    def __init__(self, simulator: LiberoSimulator):
        self.env = simulator.libero_env
        self._model, self._data = self.env.sim.model._model, self.env.sim.data._data
        self._robot = self.env.robots[0]

    @cached_property
    def goals(self) -> list[Goal]:
        """The goal's predicates, in LIBERO's order."""
        return [Goal(tuple(p), *p[1:]) for p in self.env.parsed_problem["goal_state"]]

    def reached(self, goal: Goal) -> bool:
        """LIBERO's own verdict on one predicate."""
        return bool(self.env._eval_predicate(goal.predicate))

    @property
    def objects(self) -> list[str]:
        """Names of the objects that can be moved about."""
        return list(self.env.objects_dict)

    @property
    def hand_m(self) -> np.ndarray:
        """(3,) float64 metres: the grip site."""
        return self._data.site_xpos[self._robot.eef_site_id].copy()

    @property
    def hand_rotation(self) -> np.ndarray:
        """(3, 3) float64 of the grip site."""
        return self._data.site_xmat[self._robot.eef_site_id].reshape(3, 3).copy()

    @property
    def closing_axis(self) -> np.ndarray:
        """(2,) float64 unit vector in the table plane along which the fingers close."""
        left, right = (self._data.body(f"gripper0_{side}finger").xpos for side in ("left", "right"))
        axis = (left - right)[:2]
        return axis / max(np.linalg.norm(axis), 1e-6)

    @property
    def clear_m(self) -> float:
        """Height of the hand, metres, at which it meets nothing on its way."""
        return float(self.env.workspace_offset[2]) + 0.27

    @property
    def stretched(self) -> bool:
        """Whether the elbow is straight."""
        return bool(self._data.qpos[self._robot._ref_joint_pos_indexes[3]] > _STRAIGHT_RAD)

    def reach_up_m(self, xy_m: np.ndarray) -> float:
        """Greatest height of a hand that points down, metres, at which the arm is not yet stretched out:
        there robosuite's controller lets go of the direction in which it is."""
        shoulder = self._data.body("robot0_link2").xpos
        left = _ARM_M**2 - float(np.sum((xy_m - shoulder[:2]) ** 2))
        return float(shoulder[2]) - _WRIST_M + np.sqrt(max(left, 0.0))

    def joint(self, name: str) -> FixtureJoint:
        """Returns the joint of a fixture, or of the drawer that a region belongs to."""
        site = self.env.object_sites_dict.get(name)
        names = self.env.get_object(name).joints if site is None else site.joints or []
        return FixtureJoint(self._model, self._data, names[0])

    def drawer(self, region: str) -> FixtureJoint | None:
        """The slide of the drawer that a region is in, if it is in one."""
        site = self.env.object_sites_dict.get(region)
        joint = (
            FixtureJoint(self._model, self._data, site.joints[0])
            if site is not None and site.joints
            else None
        )
        return None if joint is None or joint.hinged else joint

    def door(self, region: str) -> FixtureJoint | None:
        """The hinge of the door that a region is behind, if it is behind one."""
        parent = getattr(self.env.object_sites_dict.get(region), "parent_name", None)
        names = self.env.get_object(parent).joints if parent is not None and "heating" in region else []
        return FixtureJoint(self._model, self._data, names[0]) if names else None

    @property
    def held(self) -> str:
        """Name of the object between the fingers, if there is one."""
        return next((name for name in self.objects if self.holds(name)), "")

    def holds(self, name: str) -> bool:
        """Whether both fingers touch an object."""
        return bool(self.env._check_grasp(self._robot.gripper, self.env.get_object(name)))

    def position_m(self, name: str) -> np.ndarray:
        """(3,) float64 metres: an object's or fixture's body."""
        return self._data.xpos[self.env.obj_body_id[name]].copy()

    def upright(self, name: str) -> float:
        """Cosine of the angle between an object's own z axis and the vertical."""
        return float(self._data.xmat[self.env.obj_body_id[name]][8])

    def cloud_m(self, name: str) -> np.ndarray:
        """(n, 3) float64 metres: corners of an object's collision geometry in the world."""
        points = []
        for geom in self._collision_geoms(name):
            kind, size = self._model.geom_type[geom], self._model.geom_size[geom]
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = self._model.geom_dataid[geom]
                start = self._model.mesh_vertadr[mesh]
                local = self._model.mesh_vert[start : start + self._model.mesh_vertnum[mesh]]
            else:
                half = {
                    mujoco.mjtGeom.mjGEOM_BOX: size,
                    mujoco.mjtGeom.mjGEOM_CYLINDER: [size[0], size[0], size[1]],
                    mujoco.mjtGeom.mjGEOM_SPHERE: [size[0]] * 3,
                }.get(kind, [size[0], size[0], size[0] + size[1]])
                local = _BOX * half
            points.append(self._data.geom_xpos[geom] + local @ self._data.geom_xmat[geom].reshape(3, 3).T)
        return np.concatenate(points)

    def center_m(self, region: str) -> np.ndarray:
        """(3,) float64 metres: a region's middle, or the top of an object's."""
        if region in self.env.object_sites_dict:
            return np.array(self.env.sim.data.get_site_xpos(region))
        cloud = self.cloud_m(region)
        return np.array([*self.position_m(region)[:2], cloud[:, 2].max()])

    def rim_m(self, region: str) -> float:
        """Height of the highest thing that an object must clear on its way into a region, metres."""
        if region in self.env.obj_body_id:
            return float(self.cloud_m(region)[:, 2].max())
        drawer = self.drawer(region)
        if drawer is not None:
            return drawer.top_m
        parent = self.env.object_sites_dict[region].__dict__.get("parent_name")
        if isinstance(parent, str) and parent in self.env.obj_body_id and "contain" in region:
            return float(self.cloud_m(parent)[:, 2].max())
        return float(self.center_m(region)[2])

    def support_m(self, point_m: np.ndarray, ignore: str) -> float:
        """Height of the first collision geometry under a point, an object and the robot left out; metres."""
        left_out = subtree(self._model, [self.env.obj_body_id[ignore], *self._robot_roots])
        origin, geom = np.array(point_m, dtype=np.float64), np.zeros(1, dtype=np.int32)
        down = np.array([0.0, 0.0, -1.0])
        for _ in range(60):
            distance = mujoco.mj_ray(self._model, self._data, origin, down, _COLLISION_GROUP, 1, -1, geom)
            if distance < 0:
                return -np.inf
            origin[2] -= distance
            if int(self._model.geom_bodyid[geom[0]]) not in left_out:
                return float(origin[2])
            origin[2] -= 1e-3
        return float(origin[2])

    @cached_property
    def _robot_roots(self) -> list[int]:
        return [self._model.body(self._robot.robot_model.root_body).id]

    def _collision_geoms(self, name: str) -> np.ndarray:
        bodies = subtree(self._model, [self.env.obj_body_id[name]])
        inside = np.isin(self._model.geom_bodyid, list(bodies))
        found = np.flatnonzero(inside & (self._model.geom_contype > 0))
        return found if len(found) else np.flatnonzero(inside & (self._model.geom_conaffinity > 0))
