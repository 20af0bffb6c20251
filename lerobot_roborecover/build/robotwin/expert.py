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

from lerobot_roborecover.simulators.robotwin import RobotwinSimulator

SIDES = ("left", "right")
LARGEST_STEP_RAD = 0.12
"""Largest joint motion of one action, radians (metres for prismatic joints)."""
CLEARANCE_M = 0.10
GRASP_ABOVE_CENTRE_M = 0.005
TABLE_M = 0.741
PLACES_XY_M = ((0.0, -0.1), (0.0, 0.03), (0.1, -0.12), (-0.1, -0.12))
"""Where a tower may stand: in reach of both arms."""
THERE_M = 0.03
"""Distance below which a block stands where it belongs."""
CROWDED_M = 0.09
"""Distance to another block below which fingers would touch it."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class _Arm:
    """One arm: its joints in the articulation, and the fixed transforms between its last link and its
    fingertips."""

    side: str
    indices: list[int]
    """Of its six joints, in the articulation's active joints."""
    link: Any
    tcp_in_link: np.ndarray
    """(4, 4): fingertip centre in the last link's frame; x points along the approach."""
    closing_in_tcp: np.ndarray
    """(3,): the direction the fingers close along."""


class BlockExpert:
    """Drives a simulator that was reset to a task of blocks on a table.

    Args:
        simulator: reset, or at a handoff.
    """

    def __init__(self, simulator: RobotwinSimulator):
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

    def stack(self, order: list[str]) -> Iterator[np.ndarray]:
        """Actions that build a tower, on the first of `PLACES_XY_M` that no other block occupies.

        Args:
            order: bodies from the bottom up, e.g. `["block1", "block2"]`.
        """
        target = np.array([*self._free_place(order[0]), 0.0])
        for level, name in enumerate(order):
            position, _ = self._body(name)
            if level:
                below, _ = self._body(order[level - 1])
                target = np.array([*below[:2], below[2] + 2 * self._half_height(name) + 0.004])
            else:
                target[2] = TABLE_M + self._half_height(name) + 0.003
            if level == 0 and np.linalg.norm(position - target) < THERE_M:
                continue  # where it belongs already
            yield from self.pick_and_place(name, target)

    def recover(self, order: list[str]) -> Iterator[np.ndarray]:
        """Actions that build a tower from wherever things are: let go, fold the arms away, then `stack`.

        Args:
            order: bodies from the bottom up.
        """
        for side in SIDES:
            slot = self._slot(side)
            if np.abs(self.command[slot : slot + 6]).max() < 1e-3 and self.command[slot + 6] > 0.9:
                continue
            tcp = self.fingertips(side)
            if self.command[slot + 6] < 0.9:
                lowest = TABLE_M + 0.03
                if tcp[2, 3] > lowest + 0.02:  # put down what it may hold, rather than drop it
                    yield from self.move(side, [*tcp[:2, 3], lowest], tcp[:3, :3])
                yield from self.grip(side, 1.0)
                tcp = self.fingertips(side)
            try:
                above = self._solve(side, tcp[:3, 3] + CLEARANCE_M * UP, tcp[:3, :3])
            except RuntimeError:  # as high as the arm reaches
                pass
            else:
                yield from self._interpolate(slot, above)
            yield from self.go_home(side)
        yield from self.stack(order)

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
        position, _ = self._body(name)
        offset = position - self.fingertips(side)[:3, 3]
        goal = np.asarray(target) - offset
        yield from self.move(side, goal + CLEARANCE_M * UP, self._grasp_rotation)
        yield from self.move(side, goal, self._grasp_rotation)
        yield from self.grip(side, 1.0)
        yield from self.move(side, goal + CLEARANCE_M * UP, self._grasp_rotation)
        if go_home:
            yield from self.go_home(side)

    def pick(self, name: str, offset: np.ndarray | None = None) -> Iterator[np.ndarray]:
        """Actions that grasp a body from above and lift it.

        Args:
            name: which.
            offset: (3,) metres by which the grasp misses the body, for experts that shall fail.
        """
        position, _ = self._body(name)
        side, self._grasp_rotation = self.approach(name)
        self.side_of_grasp = side
        miss = np.zeros(3) if offset is None else np.asarray(offset)
        grasp = position + GRASP_ABOVE_CENTRE_M * UP + miss
        if self.command[self._slot(side) + 6] < 0.9:
            yield from self.grip(side, 1.0)
        yield from self.move(side, grasp + CLEARANCE_M * UP, self._grasp_rotation)
        yield from self.move(side, grasp, self._grasp_rotation)
        yield from self.grip(side, 0.0)
        yield from self.move(side, grasp + CLEARANCE_M * UP, self._grasp_rotation)

    def approach(self, name: str) -> tuple[str, np.ndarray]:
        """The arm that reaches a body, and the (3, 3) fingertip rotation to grasp it from above."""
        position, rotation = self._body(name)
        side = "left" if position[0] < 0 else "right"
        return side, self._top_down(side, rotation)

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
        count = max(1, int(np.ceil(np.abs(joints - begin).max() / LARGEST_STEP_RAD)))
        for fraction in np.linspace(0, 1, count + 1)[1:]:
            action = self.command.copy()
            action[start : start + 6] = begin + fraction * (joints - begin)
            yield self._give(action)

    def _give(self, action: np.ndarray) -> np.ndarray:
        self.command = action
        return action.copy()

    def _body(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        pose = self.simulator.bodies()[name]
        x, y, z, w = pose.quat_xyzw
        return np.array(pose.position_m), quat2mat([w, x, y, z])

    def _free_place(self, name: str) -> tuple[float, float]:
        position, _ = self._body(name)
        first = np.array([*PLACES_XY_M[0], TABLE_M + self._half_height(name)])
        if np.linalg.norm(position - first) < THERE_M:
            return PLACES_XY_M[0]
        others = [
            pose.position_m[:2]
            for body, pose in self.simulator.bodies().items()
            if body != name and not body.startswith("eef")
        ]
        for place in PLACES_XY_M:
            if all(np.linalg.norm(np.subtract(place, other)) > CROWDED_M for other in others):
                return place
        return PLACES_XY_M[0]

    def _half_height(self, name: str) -> float:
        component = getattr(self._task, name).actor.components[0]
        return float(component.get_collision_shapes()[0].half_size[2])

    def _top_down(self, side: str, rotation: np.ndarray) -> np.ndarray:
        """(3, 3) fingertip rotation: approach downwards, fingers closing along the body's nearer face."""
        closing = self._arms[side].closing_in_tcp
        current = self.fingertips(side)[:3, :3] @ closing
        down = np.array([0.0, 0.0, -1.0])
        candidates = []
        for axis in (rotation[:, 0], rotation[:, 1], -rotation[:, 0], -rotation[:, 1]):
            flat = np.array([axis[0], axis[1], 0.0])
            candidates.append(flat / np.linalg.norm(flat))
        closing_world = max(candidates, key=lambda c: float(c @ current))
        tcp_axes = np.stack([np.array([1.0, 0, 0]), closing, np.cross([1.0, 0, 0], closing)], axis=1)
        world_axes = np.stack([down, closing_world, np.cross(down, closing_world)], axis=1)
        return world_axes @ tcp_axes.T

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
        for guess in (self.command[start : start + 6], np.array([0, 0.6, 0.6, 0, 0, 0])):
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
            if size < best[0]:
                joints = np.array(solution)[arm.indices]
                best = (size, (joints + np.pi) % (2 * np.pi) - np.pi)
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
            link=link,
            tcp_in_link=np.linalg.inv(_matrix(link.get_entity_pose())) @ tcp,
            closing_in_tcp=np.round(closing, 3),
        )

    @staticmethod
    def _slot(side: str) -> int:
        return 0 if side == "left" else 7


def _matrix(pose: Any) -> np.ndarray:
    return np.asarray(pose.to_transformation_matrix(), dtype=np.float64)
