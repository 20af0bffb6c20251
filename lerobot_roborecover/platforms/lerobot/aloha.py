"""A scripted controller for gym_aloha's transfer task: the right arm picks the cube up and hands it over."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_DAMPING, _ROUNDS = 1e-1, 25
"""Of the inverse kinematics, a control step."""
_MEET_M = np.array([0.0, 0.5, 0.25])
"""Where the arms meet."""
_MET_STEP = 225
"""From which on the left arm goes for the cube where it is."""
_TIP_M = np.array([0.105, 0.0, 0.0])
"""Between the fingers, in the gripper's own frame."""
_SIDES = ("left", "right")
_ARM = {"left": slice(0, 6), "right": slice(8, 14)}
"""Joints of an arm among those of the model; two fingers follow each."""
_ACTION = {"left": slice(0, 6), "right": slice(7, 13)}
_GRIP = {"left": 6, "right": 13}
_OPEN, _CLOSED = 1.0, 0.0

type Waypoint = tuple[int, np.ndarray, np.ndarray, float]
"""Control step, (3,) position in metres, (3, 3) turn from the first pose, and the gripper's opening."""


class Transfer:
    """Follows waypoints of both grippers by inverse kinematics; joint targets are the actions.

    Args:
        inner: gym_aloha's `AlohaEnv` of the transfer task, reset; it is read and never changed.
        rng: draws where an imprecise controller believes the cube to be.
        error_m: how far off that is at most, along x and y.
    """

    def __init__(self, inner: Any, rng: np.random.Generator, *, error_m: float = 0.0):
        physics = inner._env.physics
        self._model, seen = physics.model.ptr, physics.data.ptr
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = seen.qpos
        mujoco.mj_forward(self._model, self._data)
        self._links = {s: self._model.body(f"vx300s_{s}/gripper_link").id for s in _SIDES}
        self._first = {s: self._data.xmat[b].reshape(3, 3).copy() for s, b in self._links.items()}
        begin = {s: self._data.xpos[b] + self._first[s] @ _TIP_M for s, b in self._links.items()}
        self._box = seen.xpos[self._model.body("box").id]
        cube = self._data.body("box").xpos.copy()
        cube[:2] += rng.uniform(-error_m, error_m, 2)
        upright, pick, meet = np.eye(3), _turn("y", -60.0), _turn("x", 90.0)
        up = np.array([0.0, 0.0, 1.0])
        self._ways: dict[str, list[Waypoint]] = {
            "right": [
                (0, begin["right"], upright, _CLOSED),
                (90, cube + 0.08 * up, pick, _OPEN),
                (130, cube - 0.015 * up, pick, _OPEN),
                (170, cube - 0.015 * up, pick, _CLOSED),
                (200, _MEET_M + np.array([0.05, 0.0, 0.0]), pick, _CLOSED),
                (220, _MEET_M, pick, _CLOSED),
                (310, _MEET_M, pick, _OPEN),
                (360, _MEET_M + np.array([0.1, 0.0, 0.0]), pick, _OPEN),
                (400, _MEET_M + np.array([0.1, 0.0, 0.0]), pick, _OPEN),
            ],
            "left": [
                (0, begin["left"], upright, _CLOSED),
                (100, _MEET_M + np.array([-0.1, 0.0, -0.02]), meet, _OPEN),
                (260, _MEET_M + np.array([0.02, 0.0, -0.02]), meet, _OPEN),
                (310, _MEET_M + np.array([0.02, 0.0, -0.02]), meet, _CLOSED),
                (360, _MEET_M + np.array([-0.1, 0.0, -0.02]), upright, _CLOSED),
                (400, _MEET_M + np.array([-0.1, 0.0, -0.02]), upright, _CLOSED),
            ],
        }

    def __call__(self, t: int) -> np.ndarray:
        """(14,) float64: joint targets in rad, and the grippers' openings from 0 to 1."""
        if t == _MET_STEP:  # the cube hangs where the arm's own weight lets it
            there = self._box.copy()
            self._ways["left"][1:4] = [
                (_MET_STEP, *self._ways["left"][1][1:]),
                *((w[0], there, *w[2:]) for w in self._ways["left"][2:4]),
            ]
        action = np.empty(14)
        for side in _SIDES:
            position, turn, opening = _between(self._ways[side], t + 1)
            action[_ACTION[side]] = self._reach(side, position, turn @ self._first[side])
            action[_GRIP[side]] = opening
        return action

    def _reach(self, side: str, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """(6,) joints that put the gripper there, from those of the step before."""
        model, data, link, joints = self._model, self._data, self._links[side], _ARM[side]
        jac_p, jac_r = np.empty((3, model.nv)), np.empty((3, model.nv))
        for _ in range(_ROUNDS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            tip = data.xpos[link] + data.xmat[link].reshape(3, 3) @ _TIP_M
            away = np.concatenate([position - tip, _vector(rotation, data.xmat[link])])
            if np.linalg.norm(away) < 1e-4:
                break
            mujoco.mj_jac(model, data, jac_p, jac_r, tip, link)
            jac = np.concatenate([jac_p[:, joints], jac_r[:, joints]])
            step = jac.T @ np.linalg.solve(jac @ jac.T + _DAMPING**2 * np.eye(6), away)
            low, high = model.jnt_range[joints].T
            data.qpos[joints] = np.clip(data.qpos[joints] + np.clip(step, -0.2, 0.2), low, high)
        return data.qpos[joints].copy()


def _between(way: list[Waypoint], t: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Position, turn and opening at a step."""
    after = next((i for i, w in enumerate(way) if w[0] >= t), len(way) - 1)
    (t0, p0, r0, g0), (t1, p1, r1, g1) = way[max(after - 1, 0)], way[after]
    share = min(max((t - t0) / max(t1 - t0, 1), 0.0), 1.0)
    turned = _vector(r1, r0.ravel())
    return p0 + share * (p1 - p0), _rotation(share * turned) @ r0, g0 + share * (g1 - g0)


def _vector(to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """(3,) rotation vector in the world's frame that turns (9,) `of` into (3, 3) `to`."""
    quat, vector = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quat, (to @ of.reshape(3, 3).T).ravel())
    mujoco.mju_quat2Vel(vector, quat, 1.0)
    return vector


def _rotation(vector: np.ndarray) -> np.ndarray:
    quat, matrix = np.empty(4), np.empty(9)
    angle = float(np.linalg.norm(vector))
    mujoco.mju_axisAngle2Quat(quat, vector / angle if angle else np.array([1.0, 0.0, 0.0]), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _turn(axis: str, degrees: float) -> np.ndarray:
    return _rotation(np.deg2rad(degrees) * np.eye(3)["xyz".index(axis)])
