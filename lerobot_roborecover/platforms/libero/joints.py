"""Where to take hold of a drawer, a knob or a door, from MuJoCo's model of its joint."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

_HINGE = 3
"""MuJoCo's `mjJNT_HINGE`."""


class FixtureJoint:
    """A slide or hinge of a fixture, with the collision geometry that it moves.

    Args:
        model: compiled.
        data: the simulation, read at every call.
        name: of the joint.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, name: str):
        self._model, self._data, self._id = model, data, model.joint(name).id
        of_body = model.geom_bodyid == model.jnt_bodyid[self._id]
        self._geoms = np.flatnonzero(of_body & ((model.geom_contype > 0) | (model.geom_conaffinity > 0)))
        self._panel = self._geoms[np.argmax(np.prod(model.geom_size[self._geoms], axis=1))]
        self._address = int(model.jnt_qposadr[self._id])
        low, high = model.jnt_range[self._id]
        self._away = -1.0 if -low > high else 1.0
        """Sign of the coordinate away from closed or off, which is about zero."""
        self._far = float(low if -low > high else high)
        self.body = int(model.jnt_bodyid[self._id])
        """Id of the body that it moves."""

        self.hinged = int(model.jnt_type[self._id]) == _HINGE
        """Whether it turns; else it slides."""

    @property
    def axis(self) -> np.ndarray:
        """(3,) unit vector in the world."""
        return self._data.xaxis[self._id].copy()

    @property
    def anchor_m(self) -> np.ndarray:
        """(3,) metres."""
        return self._data.xanchor[self._id].copy()

    @property
    def opening(self) -> np.ndarray:
        """(3,) unit vector along which a drawer opens."""
        return self._away * self.axis

    @property
    def outward(self) -> np.ndarray:
        """(3,) unit vector out of the opening that a door closes."""
        along = self._longest_level(self._panel)
        along = along if along @ (self._data.geom_xpos[self._panel] - self.anchor_m) > 0 else -along
        closed = Rotation.from_rotvec(-float(self._data.qpos[self._address]) * self.axis).apply(along)
        return self._away * np.cross(self.axis, closed)

    @property
    def handle_m(self) -> np.ndarray:
        """(3,) metres: middle of what stands out furthest from a drawer."""
        out = self._data.geom_xpos[self._geoms] @ self.opening
        return self._data.geom_xpos[self._geoms[np.argmax(out)]].copy()

    def way_m(self, open_it: bool) -> np.ndarray:
        """(3,) metres: how far a drawer is from all open, or from closed."""
        return ((self._far if open_it else 0.0) - float(self._data.qpos[self._address])) * self.axis

    @property
    def top_m(self) -> float:
        """Height of the highest corner."""
        return float(self._tops().max())

    @property
    def ridge_axis(self) -> np.ndarray:
        """(3,) level unit vector along the highest part of a knob."""
        return self._longest_level(self._geoms[np.argmax(self._tops())])

    def door_m(self, fraction: float, off_m: float, ahead_rad: float = 0.0) -> np.ndarray:
        """(3,) metres: a point before the face that closes a door when it is pushed.

        Args:
            fraction: of the way from the hinge to the edge.
            off_m: distance from the face.
            ahead_rad: turned so far about the hinge, towards closed.
        """
        panel = self._panel
        center, anchor = self._data.geom_xpos[panel], self.anchor_m
        along = self._longest_level(panel)
        along = along if along @ (center - anchor) > 0 else -along
        closing = -self._away * np.cross(self.axis, along)
        middle = (center - anchor) @ along
        thickness = self._model.geom_size[panel].min()
        point = center + (2 * fraction - 1) * middle * along - (thickness + off_m) * closing
        turn = Rotation.from_rotvec(-self._away * ahead_rad * self.axis)
        point = anchor + turn.apply(point - anchor)
        point[2] = self._tops()[self._geoms == panel][0] - 0.04
        return point

    def _tops(self) -> np.ndarray:
        """(n,) heights of the geoms' highest corners."""
        size = self._model.geom_size[self._geoms]
        rotation = self._data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        return self._data.geom_xpos[self._geoms, 2] + (np.abs(rotation[:, 2]) * size).sum(1)

    def _longest_level(self, geom: int) -> np.ndarray:
        """(3,) the longest of a geom's level axes."""
        rotation = self._data.geom_xmat[geom].reshape(3, 3)
        level = np.abs(rotation[2]) < 0.5
        return rotation[:, np.argmax(np.where(level, self._model.geom_size[geom], -1.0))].copy()
