"""`observation.environment_state` on LIBERO: the state observation of 77 numbers.

The same numbers mean the same in all forty tasks: the hand, the pending goal (the first that is not reached),
what is to be moved for it, where that belongs, the drawer, door or knob that plays a part, the goal after it,
and what stands next to the item. It is privileged: read from the simulator, without error and without
occlusion. What a task does not have is masked: a flag is 0, and so is all that it stands for.

Lengths are metres, in axes parallel to the world's; `from base` is relative to the robot's base, so that a
table of another height is no other task.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.boxes import BodyBoxes, Box
from lerobot_roborecover.platforms.libero.catalog import GOAL_KINDS, workable_order

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.task import LiberoTask

_NEIGHBOURS = 2
_MOVABLE_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

ENVIRONMENT_STATE: tuple[tuple[str, int], ...] = (
    ("hand.position, from base", 3),
    ("hand.rotation: first two columns of its matrix", 6),
    ("hand.opening of the two fingers together", 1),
    ("goal.kind: " + ", ".join(GOAL_KINDS), len(GOAL_KINDS)),
    ("item.centre, from base", 3),
    ("item.centre, from the hand", 3),
    ("item.rotation: first two columns of its matrix", 6),
    ("item.half extents along the axes", 3),
    ("item.held: both fingers touch it", 1),
    ("place.flag: on and in", 1),
    ("place.centre, from base", 3),
    ("place.half extents along the axes", 3),
    ("place.centre, from the item", 3),
    ("place.height of its rim over its centre", 1),
    ("part.flag: a drawer, door or knob is the item, or in the way of the place", 1),
    ("part.opening: 0 closed or off, 1 open or on", 1),
    ("part.handle, from the hand", 3),
    ("part.direction in which the handle opens it, a unit vector", 3),
    ("next.flag: another goal is to follow", 1),
    ("next.kind: " + ", ".join(GOAL_KINDS), len(GOAL_KINDS)),
    ("next.item centre, from base", 3),
    ("next.place centre, from base", 3),
    *(
        (f"neighbour {n + 1}.{name}", width)
        for n in range(_NEIGHBOURS)
        for name, width in (
            ("flag", 1),
            ("nearest point of its bounding box, from the item", 3),
            ("centre, from the item", 3),
        )
    ),
    ("goals that are not reached", 1),
)
"""What the numbers are, in their order, and how many there are of each."""

ENVIRONMENT_STATE_DIM = sum(width for _, width in ENVIRONMENT_STATE)


class _Joint(NamedTuple):
    """A drawer's slide, or a door's or a knob's hinge."""

    id: int
    closed: float
    open: float


class GoalState:
    """Reads the numbers of one task.

    Args:
        task: after its first reset; made anew when the task's model is.
    """

    def __init__(self, task: LiberoTask):
        self._task, self._env, self._model = task, task.env, task.model
        self._goals = workable_order(self._env.parsed_problem["goal_state"])
        self._joints: dict[str, _Joint | None] = {}
        robot = task.robot.robot_model
        self._base = self._env.sim.model.body_name2id(robot.root_body)
        ids = self._env.obj_body_id
        others = [name for name in ids if "table" not in name and name != "floor"]
        self._boxes = BodyBoxes(self._model, [*(ids[name] for name in others), *self._goal_bodies()])
        self._others = {name: self._boxes.row[ids[name]] for name in others}
        pads = task.robot.gripper.important_geoms
        self._fingers = [tuple(pads["left_fingerpad"]), tuple(pads["right_fingerpad"])]

    def read(self, data: mujoco.MjData) -> np.ndarray:
        """The (77,) float64 numbers of `ENVIRONMENT_STATE`.

        Args:
            data: kinematics at the sampling instant; goals, contacts and joints are the task's own, now.
        """
        self._centres, self._halves = self._boxes.read(data)
        pending = [goal for goal in self._goals if not self._env._eval_predicate(goal)]
        goal, *later = pending or self._goals[-1:]
        site, base = self._task.robot.eef_site_id, data.xpos[self._base]
        hand = data.site_xpos[site]
        fingers = data.qpos[self._task.robot._ref_gripper_joint_pos_indexes]
        item, rotation = self._item(data, goal)
        parts = [
            hand - base,
            data.site_xmat[site].reshape(3, 3)[:, :2].T.ravel(),
            [np.abs(fingers).sum()],
            _one_hot(goal[0]),
            item.centre - base,
            item.centre - hand,
            rotation[:, :2].T.ravel(),
            item.half,
            [float(self._holds(goal))],
            self._place(data, goal, item, base),
            self._part(data, goal, hand),
            self._next(data, later[0] if later else None, base),
            self._neighbours(data, goal, item.centre),
            [len(pending)],
        ]
        return np.concatenate(parts)

    def _holds(self, goal: tuple[str, ...]) -> bool:
        held = self._env.get_object(goal[1]) if goal[1] in self._env.objects_dict else None
        # robosuite's `_check_grasp`, which asks the gripper for the names each time.
        return held is not None and all(self._env.check_contact(pads, held) for pads in self._fingers)

    def _goal_bodies(self) -> Iterator[int]:
        """What `_box` is asked for, next to what stands about."""
        sites, ids = self._env.object_sites_dict, self._env.obj_body_id
        for kind, *names in self._goals:
            places = [sites[name].parent_name if name in sites else name for name in names]
            yield from (ids[name] for name in places if name in ids)
            parts = [] if kind == "on" else names[-1:]
            yield from (int(self._model.jnt_bodyid[j.id]) for j in map(self._joint, parts) if j is not None)

    def _item(self, data: mujoco.MjData, goal: tuple[str, ...]) -> tuple[Box, np.ndarray]:
        """Bounds and (3, 3) rotation of what is to be moved: an object, or the part on a joint."""
        joint = None if goal[0] in ("on", "in") else self._joint(goal[1])
        body = int(self._model.jnt_bodyid[joint.id]) if joint else self._env.obj_body_id[goal[1]]
        return self._box(body), data.xmat[body].reshape(3, 3)

    def _place(self, data: mujoco.MjData, goal: tuple[str, ...], item: Box, base: np.ndarray) -> np.ndarray:
        if len(goal) < 3:
            return np.zeros(11)
        place, rim = self._region(data, goal[2])
        return np.concatenate(
            [[1.0], place.centre - base, place.half, place.centre - item.centre, [rim - place.centre[2]]]
        )

    def _region(self, data: mujoco.MjData, name: str) -> tuple[Box, float]:
        """Bounds of a region, or the top of an object; and the height of the rim of what it is part of."""
        if name in self._env.object_sites_dict:
            site = self._env.sim.model.site_name2id(name)
            turn = np.abs(data.site_xmat[site].reshape(3, 3))
            place = Box(data.site_xpos[site], turn @ self._model.site_size[site])
            parent = self._env.object_sites_dict[name].parent_name
            rim = float(place.centre[2])
            if parent in self._env.objects_dict:  # a basket, a caddy
                box = self._box(self._env.obj_body_id[parent])
                rim = float(box.centre[2] + box.half[2])
            return place, rim
        body = self._env.obj_body_id[name]
        box = self._box(body)
        top = float(box.centre[2] + box.half[2])
        return Box(np.array([*data.xpos[body][:2], top]), box.half), top

    def _part(self, data: mujoco.MjData, goal: tuple[str, ...], hand: np.ndarray) -> np.ndarray:
        joint = self._joint(goal[-1]) if goal[0] != "on" else None
        if joint is None:
            return np.zeros(8)
        model, body = self._model, int(self._model.jnt_bodyid[joint.id])
        box = self._box(body)
        axis = data.xmat[body].reshape(3, 3) @ model.jnt_axis[joint.id]
        anchor = data.xpos[body] + data.xmat[body].reshape(3, 3) @ model.jnt_pos[joint.id]
        sign = np.sign(joint.open - joint.closed)
        if model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_SLIDE:
            direction = sign * axis
            handle = box.centre + (np.abs(direction) @ box.half) * direction
        else:
            arm = box.centre - anchor
            arm -= (arm @ axis) * axis
            long = np.linalg.norm(arm)
            outward = arm / long if long > 1e-3 else np.zeros(3)
            direction = sign * np.cross(axis, outward)
            handle = box.centre + (np.abs(outward) @ box.half) * outward
        value = data.qpos[model.jnt_qposadr[joint.id]]
        opening = (value - joint.closed) / (joint.open - joint.closed)
        return np.concatenate([[1.0, opening], handle - hand, direction])

    def _joint(self, name: str) -> _Joint | None:
        """Returns the joint of a fixture, or of the drawer that a region lies in."""
        if name not in self._joints:
            self._joints[name] = self._find_joint(name)
        return self._joints[name]

    def _find_joint(self, name: str) -> _Joint | None:
        owner, region = name, self._env.object_sites_dict.get(name)
        names: Sequence[str] = ()
        if region is not None:
            owner, names = region.parent_name, region.joints or ()
        thing = self._env.get_object(owner)
        ranges = thing.object_properties.get("articulation", {}) if thing is not None else {}
        opened = ranges.get("default_open_ranges") or ranges.get("default_turnon_ranges")
        closed = ranges.get("default_close_ranges") or ranges.get("default_turnoff_ranges")
        for joint in names or (thing.joints if thing is not None else ()):
            index = self._env.sim.model.joint_name2id(joint)
            if self._model.jnt_type[index] in _MOVABLE_JOINTS and opened and closed:
                return _Joint(index, float(np.mean(closed)), float(np.mean(opened)))
        return None

    def _next(self, data: mujoco.MjData, goal: tuple[str, ...] | None, base: np.ndarray) -> np.ndarray:
        if goal is None:
            return np.zeros(12)
        item, _ = self._item(data, goal)
        place = self._region(data, goal[2])[0].centre - base if len(goal) > 2 else np.zeros(3)
        return np.concatenate([[1.0], _one_hot(goal[0]), item.centre - base, place])

    def _neighbours(self, data: mujoco.MjData, goal: tuple[str, ...], item: np.ndarray) -> np.ndarray:
        """Returns the two nearest other objects and fixtures."""
        centres, halves = self._centres, self._halves
        nearest = centres + np.minimum(np.maximum(item - centres, -halves), halves) - item
        found = sorted(
            (math.sqrt(nearest[row].dot(nearest[row])), name, row)
            for name, row in self._others.items()
            if name != goal[1]
        )
        rows = [np.concatenate([[1.0], nearest[row], centres[row] - item]) for *_, row in found[:_NEIGHBOURS]]
        return np.concatenate([*rows, np.zeros(7 * (_NEIGHBOURS - len(rows)))])

    def _box(self, body: int) -> Box:
        """Bounds of what collides of a body and its children, at the sampling instant."""
        row = self._boxes.row[body]
        return Box(self._centres[row], self._halves[row])


def _one_hot(kind: str) -> np.ndarray:
    return np.array([float(kind == known) for known in GOAL_KINDS])
