"""Whether LIBERO's arm can follow a command, and how near its joints are to their limits.

What robosuite 1.4 offers, and what is made of it here:

- The OSC controller clips a command to [-1, 1] (`input_min`, `input_max`) and scales it to 5 cm. That is the
  range of the input, not a limit of the arm: the clipped command is what is tested.
- It has `position_limits`, but LIBERO's configuration sets none (`osc_pose.json`). Where they are set, a goal
  outside is unreachable.
- It controls torques and never solves inverse kinematics: a goal that the arm cannot reach is simply pulled
  at. So the paper's test, inverse kinematics, is done here, on robosuite's own model: damped least squares
  from the present posture to the goal position, under the joint limits of the model, the orientation kept as
  far as that goes. A joint that would leave its range is held there and the others go on.
- `Robot.check_q_limits` only says that some joint is within 0.1 rad of a limit, where the arm still works.
"""

from __future__ import annotations

import mujoco
import numpy as np

TOLERANCE_M = 0.005
"""Largest remaining distance of a goal that counts as reached: a tenth of a full command."""
_ITERATIONS = 20
_DAMPING = 0.02
_TURN_WEIGHT = 0.02
"""Metres that one radian of turned hand counts as: the position comes first. With 0.1 the iteration sticks in
a stretched posture, and places that the arm has just come from count as out of reach."""


class ArmReach:
    """Inverse kinematics of one arm on a scratch copy of the simulation.

    Args:
        model: the compiled model.
        joints: ids of the arm's hinge joints.
        site: id of the grip site.
    """

    def __init__(self, model: mujoco.MjModel, joints: np.ndarray, site: int):
        self._model, self._site = model, site
        self._data = mujoco.MjData(model)
        self._qpos = model.jnt_qposadr[joints]
        self._dofs = model.jnt_dofadr[joints]
        limited = model.jnt_limited[joints].astype(bool)
        self._low = np.where(limited, model.jnt_range[joints, 0], -np.inf)
        self._high = np.where(limited, model.jnt_range[joints, 1], np.inf)

    def margin_rad(self, qpos: np.ndarray) -> float:
        """Distance of the nearest joint from its limit.

        Args:
            qpos: (nq,) of the simulation.
        """
        q = qpos[self._qpos]
        return float(min((q - self._low).min(), (self._high - q).min()))

    def reaches(self, qpos: np.ndarray, goal_m: np.ndarray) -> bool:
        """Whether some posture near the present one puts the grip site at a place.

        Args:
            qpos: (nq,) of the simulation.
            goal_m: (3,) in the world.
        """
        data = self._data
        data.qpos[:] = qpos
        jacobian_p, jacobian_r = np.zeros((2, 3, self._model.nv))
        q = np.clip(qpos[self._qpos], self._low, self._high)
        first: np.ndarray | None = None
        for _ in range(_ITERATIONS):
            data.qpos[self._qpos] = q
            mujoco.mj_kinematics(self._model, data)
            mujoco.mj_comPos(self._model, data)
            rotation = data.site_xmat[self._site].reshape(3, 3)
            first = rotation.copy() if first is None else first
            off = goal_m - data.site_xpos[self._site]
            if np.linalg.norm(off) < TOLERANCE_M:
                return True
            turned = 0.5 * sum(np.cross(rotation[:, k], first[:, k]) for k in range(3))
            mujoco.mj_jacSite(self._model, data, jacobian_p, jacobian_r, self._site)
            rows = np.concatenate([jacobian_p, _TURN_WEIGHT * jacobian_r])[:, self._dofs]
            error = np.concatenate([off, _TURN_WEIGHT * turned])
            q = self._improved(q, rows, error)
        return False

    def _improved(self, q: np.ndarray, rows: np.ndarray, error: np.ndarray) -> np.ndarray:
        """One damped step within the limits; joints that it would push beyond theirs are held and the step is
        taken with the rest."""
        free = np.ones(len(q), dtype=bool)
        for _ in q:
            moved = rows * free
            step = moved.T @ np.linalg.solve(moved @ moved.T + _DAMPING**2 * np.eye(6), error)
            better = np.clip(q + step, self._low, self._high)
            held = free & (better != q + step) & (np.abs(better - q) < 1e-9)
            if not held.any():
                break
            free &= ~held
        return better
