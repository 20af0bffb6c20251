"""Scripted controllers for ManiSkill's tasks, from the simulator's own state.

ManiSkill's motion planners drive absolute joint positions and step the environment themselves; these give
one delta of the hand (Panda) or of the joints (SO-100) at a time, which `collect --perturb` can disturb.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_roborecover.platforms.base import Controller, Expert
from lerobot_roborecover.platforms.simulator import GOAL
from lerobot_roborecover.scenario import Task

type Plan = Iterator[np.ndarray]
type Place = Callable[[], np.ndarray]
"""(3,) world position, metres; asked at every step."""
_UP = np.array([0.0, 0.0, 1.0])


class _Panda:
    """Moves the hand: 0.1 m and 0.1 rad at most a step; ManiSkill turns by the negative of what is asked."""

    opened, closed, hover_m = 1.0, -1.0, 0.08

    def __init__(self, simulator: Any):
        self._sim = simulator

    def down(self, closing: np.ndarray) -> Rotation:
        return Rotation.from_matrix(np.stack([np.cross(closing, -_UP), closing, -_UP], axis=1))

    def closing(self, hand: Rotation) -> np.ndarray:
        return hand.as_matrix()[:, 1]

    def action(self, where: np.ndarray, turn: Rotation, grip: float, most: float) -> np.ndarray:
        hand = self._sim.bodies()["eef"]
        rotate = (turn * Rotation.from_quat(hand.quat_xyzw).inv()).as_rotvec() / -0.1
        return np.array([*_cut((where - hand.position_m) / 0.067, most), *_cut(rotate, 1.0), grip])

    def still(self, grip: float) -> np.ndarray:
        return np.array([0.0, 0, 0, 0, 0, 0, grip])


class _So100:
    """Moves the joints: 0.05 rad at most a step, towards what inverse kinematics finds for the point between
    the jaws. Five joints do not reach every rotation: place counts for more. The grip is an angle, rad."""

    opened, closed, hover_m = 0.0, -0.8, 0.04

    def __init__(self, simulator: Any):
        self._robot = simulator.env.agent.robot
        self._model = self._robot._objs[0].create_pinocchio_model()
        names = [link.name for link in self._robot.links]
        self._links = [names.index(n) for n in ("Fixed_Jaw_tip", "Moving_Jaw_tip", "Fixed_Jaw")]
        self._base = Rotation.from_quat(self._robot.pose.q[0].numpy(), scalar_first=True)

    def down(self, closing: np.ndarray) -> Rotation:
        return Rotation.from_matrix(np.stack([closing, _UP, np.cross(closing, _UP)], axis=1))

    def closing(self, hand: Rotation) -> np.ndarray:
        return hand.as_matrix()[:, 0]

    def action(self, where: np.ndarray, turn: Rotation, grip: float, most: float) -> np.ndarray:
        def left(joints: np.ndarray) -> np.ndarray:
            self._model.compute_forward_kinematics(joints)
            a, b, jaw = (self._model.get_link_pose(i) for i in self._links)
            at = self._robot.pose.p[0].numpy() + self._base.apply((a.p + b.p) / 2.0)
            hand = self._base * Rotation.from_quat(jaw.q, scalar_first=True)
            return np.concatenate([where - at, 0.05 * (turn * hand.inv()).as_rotvec()])

        q = self._robot.get_qpos()[0].double().numpy()
        for _ in range(8):  # damped least squares
            error = left(q)
            slope = np.stack([(error - left(q + 1e-4 * np.eye(6)[j])) / 1e-4 for j in range(5)], axis=1)
            q[:5] += slope.T @ np.linalg.solve(slope @ slope.T + 1e-5 * np.eye(6), error)
            q = np.clip(q, *self._robot.get_qlimits()[0].numpy().T)
        move = (q - self._aimed())[:5] / 0.05
        move *= min(1.0, 2.0 * most / max(np.abs(move).max(), 1e-9))
        return np.array([*move, self.still(grip)[5]])

    def still(self, grip: float) -> np.ndarray:
        return np.array([0.0, 0, 0, 0, 0, (grip - self._aimed()[5]) / 0.2])

    def _aimed(self) -> np.ndarray:
        return self._robot.get_drive_targets()[0].double().numpy()


class _Hand:
    """One controller: what it sees, and where it goes. `open_loop` looks once, at the beginning; objects seem
    to be `error_m` off at least and at most, horizontally."""

    def __init__(
        self, simulator: Any, rng: np.random.Generator, open_loop: bool, error_m: tuple[float, float]
    ):
        self.sim, self.arm = simulator, (_Panda if simulator.action_dim == 7 else _So100)(simulator)
        self._first = simulator.bodies() if open_loop else None
        angle, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*error_m)
        self._error = far * np.array([np.cos(angle), np.sin(angle), 0.0])
        self.turn = Rotation.from_quat(simulator.bodies()["eef"].quat_xyzw)

    def at(self) -> np.ndarray:
        return np.array(self.sim.bodies()["eef"].position_m)

    def see(self, name: str) -> np.ndarray:
        place = np.array((self._first or self.sim.bodies())[name].position_m)
        return place if name == GOAL else place + self._error

    def across(self, name: str, sides: int = 4) -> None:
        """Turns the hand down, to close across the object's nearest of so many sides."""
        axis = Rotation.from_quat(self.sim.bodies()[name].quat_xyzw).as_matrix()[:, 1] * (1, 1, 0)
        axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 0.1 else np.array([0.0, 1.0, 0.0])
        now = self.arm.closing(Rotation.from_quat(self.sim.bodies()["eef"].quat_xyzw))
        turns = [Rotation.from_rotvec(2 * np.pi * k / sides * _UP).apply(axis) for k in range(sides)]
        self.turn = self.arm.down(max(turns, key=lambda a: a @ now))

    def to(
        self, where: Place, grip: float, near_m: float = 0.012, steps: int = 25, most: float = 0.5
    ) -> Plan:
        """Goes somewhere, until it is there, or for so many steps, at `most` of the largest command."""
        for _ in range(steps):
            if np.linalg.norm(where() - self.at()) < near_m:
                return
            yield self.arm.action(where(), self.turn, grip, most)

    def hold(self, grip: float, steps: int) -> Plan:
        for _ in range(steps):
            yield self.arm.still(grip)

    def grasp(self, name: str, sides: int = 4) -> Plan:
        """From above."""
        self.across(name, sides)
        yield from self.to(lambda: self.see(name) + self.arm.hover_m * _UP, self.arm.opened, 0.02)
        yield from self.to(lambda: self.see(name), self.arm.opened, 0.008, 20, 0.35)
        yield from self.hold(self.arm.closed, 5)

    def carry(self, name: str, where: Place) -> Plan:
        """Brings an object that is in the grasp (or that it thinks is) to where its middle should be."""
        off = np.zeros(3) if self._first else self.at() - self.see(name)
        off *= np.linalg.norm(off) < 0.05
        yield from self.to(lambda: where() + off, self.arm.closed, 0.005, 25, 0.4)

    def release(self) -> Plan:
        yield from self.hold(self.arm.opened, 3)
        yield from self.to(lambda: self.at() + 0.1 * _UP, self.arm.opened, 0.0, 5)
        yield from self.hold(self.arm.opened, 2)


def _pick(hand: _Hand) -> Plan:
    yield from hand.grasp("cube")
    yield from hand.carry("cube", lambda: hand.see(GOAL))
    yield from hand.hold(hand.arm.closed, 8)


def _put(hand: _Hand, name: str) -> Plan:
    yield from hand.grasp(name)
    for above_m in (0.06, 0.004):
        yield from hand.carry(name, lambda up=above_m: hand.see(GOAL) + up * _UP)
    yield from hand.release()


def _push(hand: _Hand, side: float) -> Plan:
    """From behind (-1) or from the front (1): down beside the cube, then along x until the cube is there."""
    closed, beside = hand.arm.closed, np.array([0.07 * side, 0.0, 0.0])
    yield from hand.to(lambda: hand.see("cube") + beside + 0.1 * _UP * (side > 0), closed, 0.03)
    yield from hand.to(lambda: hand.see("cube") + beside, closed, 0.015)
    yield from hand.to(lambda: hand.see(GOAL) + 0.4 * beside, closed, 0.01, 30, 0.35)


def _poke(hand: _Hand) -> Plan:
    """Pushes the cube with the peg: its head is 12 cm before its middle."""
    yield from hand.grasp("peg", 2)
    yield from hand.to(lambda: hand.see("cube") + np.array([-0.17, 0.0, 0.01]), hand.arm.closed)
    yield from hand.to(
        lambda: hand.see(GOAL) + np.array([-0.14, 0.0, 0.01]), hand.arm.closed, steps=25, most=0.3
    )
    yield from hand.hold(hand.arm.closed, 5)


def _lift(hand: _Hand) -> Plan:
    """Grasps the cube and goes back to the joints of ManiSkill's rest pose."""
    yield from hand.grasp("cube-0")
    for _ in range(40):
        away = (hand.sim.env.rest_qpos - hand.sim.env.agent.robot.get_drive_targets()[0]).numpy()[:5]
        yield np.array([*np.clip(away / 0.05, -0.6, 0.6), hand.arm.still(hand.arm.closed)[5]])


PLANS: dict[str, Callable[[_Hand], Plan]] = {
    "PickCube-v1": _pick, "PickCubeSO100-v1": _pick, "SO100GraspCube-v1": _lift, "PokeCube-v1": _poke,
    "PushCube-v1": lambda hand: _push(hand, -1.0), "PullCube-v1": lambda hand: _push(hand, 1.0),
    "StackCube-v1": lambda hand: _put(hand, "cubeA"), "PlaceSphere-v1": lambda hand: _put(hand, "sphere"),
}  # fmt: skip
"""By task."""


def _cut(values: np.ndarray, most: float) -> np.ndarray:
    return values * min(1.0, most / max(np.linalg.norm(values), 1e-9))


def _expert(about: str, open_loop: bool = False, error_m: tuple[float, float] = (0.0, 0.0)) -> Expert:
    def make(simulator: Any, task: Task, rng: np.random.Generator) -> Controller:
        hand = _Hand(simulator, rng, open_loop, error_m)

        def drive() -> Plan:
            yield from PLANS[task.name](hand)
            while not open_loop and not error_m[1]:
                yield from hand.release()
                yield from PLANS[task.name](hand)
            yield from hand.hold(hand.arm.closed, 10**6)

        actions = drive()
        return lambda _t: np.clip(next(actions), -1.0, 1.0)

    return Expert(make, about)


EXPERTS = {
    "scripted": _expert("looks at every step, and tries again until it is done"),
    "open-loop": _expert("looks once, and tries once", open_loop=True),
    "biased": _expert("sees objects 1.5 to 4.5 cm off, and tries once", error_m=(0.015, 0.045)),
}
