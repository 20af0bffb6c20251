"""Bounds along the world's axes of what collides of bodies, of many of them at once."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np

from lerobot_roborecover.platforms.mujoco_state import subtree


class Box(NamedTuple):
    """Bounds along the world's axes, metres."""

    centre: np.ndarray
    """(3,) float64."""
    half: np.ndarray
    """(3,) float64."""


class BodyBoxes:
    """Each of a body and its children; where nothing of them collides, the body's own place.

    Args:
        model: the compiled model.
        bodies: ids of the bodies.
    """

    def __init__(self, model: mujoco.MjModel, bodies: Iterable[int]):
        self.row = {body: row for row, body in enumerate(dict.fromkeys(bodies))}
        collides = (model.geom_contype | model.geom_conaffinity) > 0
        geoms = [
            np.flatnonzero(np.isin(model.geom_bodyid, list(subtree(model, [body]))) & collides)
            for body in self.row
        ]
        counts = np.array([len(of_body) for of_body in geoms], dtype=int)
        self._bodies = np.array(list(self.row), dtype=int)
        self._solid = np.flatnonzero(counts)
        """Rows of the bodies that have bounds."""
        self._geoms = np.concatenate([*geoms, np.zeros(0, int)])
        self._starts = np.concatenate([[0], np.cumsum(counts[self._solid])[:-1]]).astype(int)
        self._local = model.geom_aabb[self._geoms]

    def read(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Centres and half extents, both (bodies, 3) float64 metres, in the order of `row`."""
        centres, halves = data.xpos[self._bodies], np.zeros((len(self._bodies), 3))
        if len(self._solid):
            turns = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
            middle = data.geom_xpos[self._geoms] + np.einsum("gij,gj->gi", turns, self._local[:, :3])
            extent = np.einsum("gij,gj->gi", np.abs(turns), self._local[:, 3:])
            low = np.minimum.reduceat(middle - extent, self._starts)
            high = np.maximum.reduceat(middle + extent, self._starts)
            centres[self._solid], halves[self._solid] = (low + high) / 2, (high - low) / 2
        return centres, halves
