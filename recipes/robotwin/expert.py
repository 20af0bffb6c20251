"""A scripted driver of RoboTwin's block-stacking tasks in joint space, from privileged state.

RoboTwin's own expert plans with curobo, which needs an NVIDIA GPU. This one needs neither: it moves grippers
along straight lines between a few waypoints, with inverse kinematics by damped least squares, and gives
absolute joint targets, as a policy would. It decides anew from the current scene whenever it is started, so
it also continues from a recovery point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from transforms3d.quaternions import mat2quat, quat2mat

from lerobot_roborecover.platforms.robotwin.simulator import RobotwinSimulator

SIDES = ("left", "right")
LARGEST_STEP_RAD = 0.12
"""Of one action, as a policy would give it."""
CLEARANCE_M = 0.10
LOW_CLEARANCE_M = 0.065
"""Where the arm does not reach as high."""
GRASP_ABOVE_CENTRE_M = 0.005
TABLE_M = 0.741
PLACES_XY_M = ((0.0, -0.1), (0.0, 0.03), (0.1, -0.12), (-0.1, -0.12))
"""Where a tower may stand: in reach of both arms."""
THERE_M = 0.03
"""Distance below which a block stands where it belongs."""
GRASP_BELOW_TOP_M = 0.03
"""Of a body taller than a cube."""
HOLDING_M = 0.01
"""Of a finger's opening, above which there is something between the fingers."""
PUT_DOWN_XY_M = tuple((x, y) for y in (-0.12, 0.0) for x in (-0.22, -0.12, 0.0, 0.12, 0.22))
"""Where a body may be put aside."""
CROWDED_M = 0.09
"""Distance to another block below which fingers would touch it."""
UP = np.array([0.0, 0.0, 1.0])
_BENDS = ((1.2, 0.9, -0.3), (1.6, 1.3, -0.3), (2.0, 1.6, 0.4))
"""Of an arm's middle joints, radians: where inverse kinematics starts when it fails from the usual places."""
_RANGE_RAD = np.array([[-2.6, -0.2, -0.2, -1.8, -2.0, -3.2], [2.6, 3.6, 3.2, 1.8, 2.0, 3.2]])
"""(2, 6) in place of limits of more than a turn: those of RoboTwin's robot are 10 radians."""
_STEEP = 0.7
"""Vertical part of an approach from above."""


@dataclass
class _Arm:
    """One arm: its joints in the articulation, and the fixed transforms between its last link and its
    fingertips."""

    side: str
    indices: list[int]
    """Of its six joints, in the articulation's active joints."""
    limits: np.ndarray
    """(2, 6) lowest and highest values that the controller gives its joints."""
    link: Any
    tcp_in_link: np.ndarray
    """(4, 4): fingertip centre in the last link's frame; x points along the approach."""
    closing_in_tcp: np.ndarray
    """(3,): the direction the fingers close along."""


class BlockExpert:
    """Drives a simulator that was reset to a task of blocks on a table.

    Args:
        simulator: reset, or at a handoff.
        largest_step_rad: largest joint motion of one action, radians (metres for prismatic joints).
    """

    def __init__(self, simulator: RobotwinSimulator, largest_step_rad: float = LARGEST_STEP_RAD):
        self._largest_step_rad = largest_step_rad
        self.simulator = simulator
        self._task = simulator.robotwin_task.task
        robot = self._task.robot
        self._entity = robot.left_entity
        self._model = self._entity.create_pinocchio_model()
        self._links = list(self._entity.get_links())
        self._arms = {side: self._arm(side) for side in SIDES}
        self.command = simulator.robotwin_task.joint_state()
        """(14,) joint targets last given."""
        self.side_of_grasp = "left"
        """The arm that last grasped."""
        self._grasp_rotation = np.eye(3)

    def let_go(self) -> Iterator[np.ndarray]:
        """Actions that put down whatever the grippers hold, on the table and clear of the other bodies, and
        fold both arms away."""
        for side in SIDES:
            slot = self._slot(side)
            if np.abs(self.command[slot : slot + 6]).max() < 1e-3 and self.command[slot + 6] > 0.9:
                continue
            if self.command[slot + 6] < 0.9:
                held = self.held(side)
                if held is not None:
                    yield from self._put_down(side, held)
                yield from self.grip(side, 1.0)
            yield from self.retreat(side)
            yield from self.go_home(side)

    def retreat(self, side: str) -> Iterator[np.ndarray]:
        """Actions that take open fingers off what they held: upwards, or back where they came from."""
        tcp = self.fingertips(side)
        away = UP if abs(tcp[2, 0]) > _STEEP else -tcp[:3, 0]
        try:
            joints = self._solve(side, tcp[:3, 3] + CLEARANCE_M * away, tcp[:3, :3])
        except RuntimeError:  # as far as the arm reaches
            return
        yield from self._interpolate(self._slot(side), joints)

    def held(self, side: str) -> str | None:
        """The body between an arm's fingers, if any."""
        tcp = self.fingertips(side)[:3, 3]
        if self._finger_m(side) < HOLDING_M:
            return None
        for name, position in self._positions().items():
            near = np.abs(tcp - position)
            if near[:2].max() < THERE_M and near[2] < self.half_height(name) + 0.01:
                return name
        return None

    def _put_down(self, side: str, name: str) -> Iterator[np.ndarray]:
        """Actions that bring a held body down where it is, or to the nearest place that is clear."""
        tcp = self.fingertips(side)
        position, _ = self.body(name)
        offset = position - tcp[:3, 3]
        resting = TABLE_M + self.half_height(name) + 0.003
        if self._is_clear(position[:2], name):
            if position[2] > resting + 0.01:
                yield from self.move(side, np.array([*position[:2], resting]) - offset, tcp[:3, :3])
            return
        clear = [place for place in PUT_DOWN_XY_M if self._is_clear(place, name)]
        refusal = RuntimeError(f"no clear place to put {name} down")
        for place in sorted(clear, key=lambda xy: float(np.linalg.norm(xy - position[:2]))):
            path = []
            try:
                for xy, z in (
                    (position[:2], max(position[2], resting) + LOW_CLEARANCE_M),
                    (place, max(position[2], resting) + LOW_CLEARANCE_M),
                    (place, resting),
                ):
                    path.append(self._solve(side, np.array([*xy, z]) - offset, tcp[:3, :3]))
            except RuntimeError as err:
                refusal = err
                continue
            for joints in path:
                yield from self._interpolate(self._slot(side), joints)
            return
        raise refusal

    def hold(self, steps: int) -> Iterator[np.ndarray]:
        """Actions that stay where the arms are."""
        for _ in range(steps):
            yield self._give(self.command)

    def pick_and_place(self, name: str, target: np.ndarray, *, go_home: bool = True) -> Iterator[np.ndarray]:
        """Actions that grasp a body from above and put its centre at `target` (3,) metres.

        Args:
            name: which body.
            target: where to, metres.
            go_home: fold the arm away afterwards, so that the other one has room.
        """
        yield from self.pick(name)
        side = self.side_of_grasp
        position, _ = self.body(name)
        offset = position - self.fingertips(side)[:3, 3]
        goal = np.asarray(target) - offset
        yield from self.move_above(side, goal, self._grasp_rotation)
        yield from self.move(side, goal, self._grasp_rotation)
        yield from self.grip(side, 1.0)
        yield from self.move_above(side, goal, self._grasp_rotation)
        if go_home:
            yield from self.go_home(side)

    def pick(self, name: str, offset: np.ndarray | None = None) -> Iterator[np.ndarray]:
        """Actions that grasp a body from above and lift it.

        Args:
            name: which.
            offset: (3,) metres by which the grasp misses the body, for experts that shall fail.
        """
        position, _ = self.body(name)
        side, self._grasp_rotation = self.approach(name)
        self.side_of_grasp = side
        miss = np.zeros(3) if offset is None else np.asarray(offset)
        grasp = position + self._grasp_height(name) * UP + miss
        if self.command[self._slot(side) + 6] < 0.9:
            yield from self.grip(side, 1.0)
        yield from self.move(side, grasp + CLEARANCE_M * UP, self._grasp_rotation)
        yield from self.move(side, grasp, self._grasp_rotation)
        yield from self.grip(side, 0.0)
        yield from self.move(side, grasp + CLEARANCE_M * UP, self._grasp_rotation)

    def _grasp_height(self, name: str) -> float:
        """Of the fingertips above a body's centre, metres: low in a cube, near the top of a tall box."""
        return max(GRASP_ABOVE_CENTRE_M, self.half_height(name) - GRASP_BELOW_TOP_M)

    def approach(self, name: str) -> tuple[str, np.ndarray]:
        """The arm that reaches a body, and the (3, 3) fingertip rotation to grasp it from above."""
        position, rotation = self.body(name)
        side = "left" if position[0] < 0 else "right"
        return side, self.top_down(side, rotation)

    def closing(self, side: str) -> np.ndarray:
        """(3,) direction an arm's fingers close along, in the fingertips' frame."""
        return self._arms[side].closing_in_tcp

    def opening(self, side: str) -> float:
        """How far a gripper was last told to open, 0 to 1."""
        return float(self.command[self._slot(side) + 6])

    def move(self, side: str, position: np.ndarray, rotation: np.ndarray) -> Iterator[np.ndarray]:
        """Actions that bring an arm's fingertips to a pose, in joint space."""
        start = self._slot(side)
        joints = self._solve(side, np.asarray(position, dtype=np.float64), rotation)
        yield from self._interpolate(start, joints)

    def move_above(self, side: str, position: np.ndarray, rotation: np.ndarray) -> Iterator[np.ndarray]:
        """Actions that bring an arm's fingertips above a position, lower where the arm reaches no higher."""
        slot = self._slot(side)
        try:
            joints = self._solve(side, position + CLEARANCE_M * UP, rotation)
        except RuntimeError:
            joints = self._solve(side, position + LOW_CLEARANCE_M * UP, rotation)
        yield from self._interpolate(slot, joints)

    def go_home(self, side: str) -> Iterator[np.ndarray]:
        """Actions that fold an arm away."""
        yield from self._interpolate(self._slot(side), np.zeros(6))

    def grip(self, side: str, opening: float) -> Iterator[np.ndarray]:
        """Actions that open (1) or close (0) a gripper."""
        index = self._slot(side) + 6
        start = self.command[index]
        for fraction in np.linspace(0, 1, 7)[1:]:
            action = self.command.copy()
            action[index] = start + fraction * (opening - start)
            yield self._give(action)

    def _interpolate(self, start: int, joints: np.ndarray) -> Iterator[np.ndarray]:
        begin = self.command[start : start + 6].copy()
        count = max(1, int(np.ceil(np.abs(joints - begin).max() / self._largest_step_rad)))
        for fraction in np.linspace(0, 1, count + 1)[1:]:
            action = self.command.copy()
            action[start : start + 6] = begin + fraction * (joints - begin)
            yield self._give(action)

    def _give(self, action: np.ndarray) -> np.ndarray:
        self.command = action
        return action.copy()

    def body(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(3,) position in metres and (3, 3) rotation of a body."""
        pose = self.simulator.bodies()[name]
        x, y, z, w = pose.quat_xyzw
        return np.array(pose.position_m), quat2mat([w, x, y, z])

    def half_height(self, name: str) -> float:
        """Half the height of a standing box, metres."""
        component = getattr(self._task, name).actor.components[0]
        return float(component.get_collision_shapes()[0].half_size[2])

    def half_width(self, name: str) -> float:
        """Half the width of a standing box, metres."""
        component = getattr(self._task, name).actor.components[0]
        return float(component.get_collision_shapes()[0].half_size[0])

    def free_place(self, name: str) -> tuple[float, float]:
        """The first of `PLACES_XY_M` where no other body stands in the way of a tower, metres."""
        position, _ = self.body(name)
        if np.linalg.norm(position[:2] - PLACES_XY_M[0]) < THERE_M:
            return PLACES_XY_M[0]
        return next((place for place in PLACES_XY_M if self._is_clear(place, name)), PLACES_XY_M[0])

    def _positions(self) -> dict[str, np.ndarray]:
        """(3,) positions of everything but the end effectors, metres."""
        bodies = self.simulator.bodies().items()
        return {name: np.array(pose.position_m) for name, pose in bodies if not name.startswith("eef")}

    def _is_clear(self, place: Any, name: str) -> bool:
        """Whether fingers that put a body down there touch no other one."""
        others = (position for other, position in self._positions().items() if other != name)
        return all(np.linalg.norm(np.subtract(place, other[:2])) > CROWDED_M for other in others)

    def _finger_m(self, side: str) -> float:
        """How far an arm's first finger stands open, metres."""
        joint = getattr(self._task.robot, f"{side}_gripper")[0][0]
        active = [j.name for j in self._entity.get_active_joints()]
        return float(self._entity.get_qpos()[active.index(joint.name)])

    def top_down(self, side: str, rotation: np.ndarray) -> np.ndarray:
        """(3, 3) fingertip rotation: approach downwards, fingers closing along the body's nearer face."""
        current = self.fingertips(side)[:3, :3] @ self._arms[side].closing_in_tcp
        candidates = []
        for axis in (rotation[:, 0], rotation[:, 1], -rotation[:, 0], -rotation[:, 1]):
            flat = np.array([axis[0], axis[1], 0.0])
            candidates.append(flat / np.linalg.norm(flat))
        closing_world = max(candidates, key=lambda c: float(c @ current))
        return self.facing(side, -UP, closing_world)

    def facing(self, side: str, approach: np.ndarray, closing_world: np.ndarray) -> np.ndarray:
        """(3, 3) fingertip rotation that approaches along one (3,) direction and closes along another."""
        closing = self._arms[side].closing_in_tcp
        tcp_axes = np.stack([np.array([1.0, 0, 0]), closing, np.cross([1.0, 0, 0], closing)], axis=1)
        world_axes = np.stack([approach, closing_world, np.cross(approach, closing_world)], axis=1)
        return world_axes @ tcp_axes.T

    def shoulder(self, side: str) -> np.ndarray:
        """(3,) metres: where an arm's first joint is."""
        joint = getattr(self._task.robot, f"{side}_arm_joints")[0]
        return np.asarray(joint.get_child_link().get_entity_pose().p, dtype=np.float64)

    def _solve(self, side: str, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """(6,) joint values that put an arm's fingertips at a pose.

        Raises:
            RuntimeError: the pose is out of reach.
        """
        import sapien

        arm = self._arms[side]
        tcp = np.eye(4)
        tcp[:3, :3], tcp[:3, 3] = rotation, position
        link = _matrix(self._entity.get_root_pose().inv()) @ tcp @ np.linalg.inv(arm.tcp_in_link)
        qpos = self._entity.get_qpos()
        mask = np.zeros(len(qpos), dtype=np.int32)
        mask[arm.indices] = 1
        start = self._slot(side)
        best = (np.inf, np.zeros(6))
        turn = np.arctan2(*(self.shoulder(side) - position)[:2]) % (2 * np.pi) - np.pi
        guesses = [self.command[start : start + 6], np.array([0, 0.6, 0.6, 0, 0, 0])]
        sign = 1.0 if side == "left" else -1.0
        guesses += [np.array([-turn, *bend, sign * wrist, 0]) for wrist in (0, 1.2) for bend in _BENDS]
        for guess in guesses:
            qpos[arm.indices] = guess
            solution, _, error = self._model.compute_inverse_kinematics(
                self._links.index(arm.link),
                sapien.Pose(link[:3, 3], mat2quat(link[:3, :3])),
                initial_qpos=qpos,
                active_qmask=mask,
                eps=1e-4,
                max_iterations=2000,
                damp=1e-4,
            )
            size = float(np.linalg.norm(error))
            joints = (np.array(solution)[arm.indices] + np.pi) % (2 * np.pi) - np.pi
            if (joints < arm.limits[0]).any() or (joints > arm.limits[1]).any():
                size = np.inf
            if size < best[0]:
                best = (size, joints)
            if size < 1e-3:
                break
        if best[0] > 5e-3:
            raise RuntimeError(f"the {side} arm cannot reach {position} (error {best[0]:.4f})")
        return best[1]

    def fingertips(self, side: str) -> np.ndarray:
        """(4, 4) pose of the centre between an arm's fingertips; x points along the approach."""
        robot = self._task.robot
        values = robot.get_left_tcp_pose() if side == "left" else robot.get_right_tcp_pose()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = quat2mat(values[3:7]), values[:3]
        return matrix

    def _arm(self, side: str) -> _Arm:
        robot = self._task.robot
        joints = getattr(robot, f"{side}_arm_joints")
        link = joints[-1].get_child_link()
        active = [joint.name for joint in self._entity.get_active_joints()]
        tcp = self.fingertips(side)
        finger = getattr(robot, f"{side}_gripper")[0][0]
        closing = tcp[:3, :3].T @ quat2mat(finger.get_global_pose().q)[:, 0]
        return _Arm(
            side=side,
            indices=[active.index(joint.name) for joint in joints],
            limits=_sensible(np.array([joint.get_limits()[0] for joint in joints]).T),
            link=link,
            tcp_in_link=np.linalg.inv(_matrix(link.get_entity_pose())) @ tcp,
            closing_in_tcp=np.round(closing, 3),
        )

    @staticmethod
    def _slot(side: str) -> int:
        return 0 if side == "left" else 7


def _sensible(limits: np.ndarray) -> np.ndarray:
    """(2, 6) limits, with ours where a joint has none to speak of."""
    return np.where(np.abs(limits).max(axis=0) > 2 * np.pi, _RANGE_RAD, limits)


def _matrix(pose: Any) -> np.ndarray:
    return np.asarray(pose.to_transformation_matrix(), dtype=np.float64)
