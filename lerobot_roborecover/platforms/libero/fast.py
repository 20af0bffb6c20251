"""LIBERO's pictures for a machine without a GPU: a tenth of the cost and less.

Where the time of a picture goes in software: 200,000 faces are drawn, most of them smaller than a pixel, each
again for the reflecting floor and once per shadow, and every pixel four times for smooth edges. None of that
touches the physics: what is drawn is a copy of the model.
"""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.decimation import Surface, cached_decimation

_FACES_PER_PIXEL = 6
_FEWEST_FACES = 600
"""Of a mesh 10 cm long or longer; what is drawn is some sixty meshes."""
_SMALL_M = 0.1
"""A shorter mesh gets fewer faces, in proportion, down to a tenth."""
_COLLISION_GROUP = 0


def light_copy(model: mujoco.MjModel, pixels: int, cache: Path) -> mujoco.MjModel:
    """A copy of a model to draw from, without shadows and multisampling, with fewer faces.

    Args:
        model: is not touched.
        pixels: the longer side of the pictures: a mesh gets six faces for each pixel, at least 600.
        cache: folder of decimated meshes.

    Raises:
        SimulatorError: the package fast-simplification is missing.
    """
    drawn = copy.copy(model)
    drawn.vis.quality.offsamples = drawn.vis.quality.shadowsize = 0
    drawn.mesh_graphadr[:] = -1  # convex hulls, which are not rendered
    most = max(_FEWEST_FACES, _FACES_PER_PIXEL * pixels)
    seen = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group != _COLLISION_GROUP)
    for mesh in np.unique(model.geom_dataid[seen]):
        surface = _surface(model, mesh)
        faces = int(most * np.clip(np.ptp(surface.points, axis=0).max() / _SMALL_M, 0.1, 1))
        if len(surface.faces) > faces:
            _replace(drawn, mesh, cached_decimation(surface, faces, cache))
    return drawn


def without_reflections(scene: mujoco.MjvScene) -> None:
    """Draws everything once, and no shadows."""
    for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SHADOW):
        scene.flags[flag] = 0


def _surface(model: mujoco.MjModel, mesh: int) -> Surface:
    def rows(values: np.ndarray, first: np.ndarray, count: np.ndarray) -> np.ndarray:
        start = max(first[mesh], 0)  # -1 without texture coordinates
        return values[start : start + count[mesh]]

    faces = model.mesh_faceadr, model.mesh_facenum
    painted = model.mesh_facetexcoord if model.mesh_texcoordnum[mesh] else np.zeros((0, 3), np.int32)
    return Surface(
        rows(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum),
        rows(model.mesh_face, *faces),
        rows(model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum),
        rows(model.mesh_facenormal, *faces),
        rows(model.mesh_texcoord, model.mesh_texcoordadr, model.mesh_texcoordnum),
        rows(painted, *faces),
    )


def _replace(model: mujoco.MjModel, mesh: int, surface: Surface) -> None:
    """Writes a smaller mesh over a model's, if it fits: faces that share their normals leave little room."""
    attributes = (
        (model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, surface.points),
        (model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum, surface.normals),
        (model.mesh_texcoord, model.mesh_texcoordadr, model.mesh_texcoordnum, surface.texcoords),
        (model.mesh_face, model.mesh_faceadr, model.mesh_facenum, surface.faces),
        (model.mesh_facenormal, model.mesh_faceadr, model.mesh_facenum, surface.normal_faces),
        (model.mesh_facetexcoord, model.mesh_faceadr, model.mesh_facenum, surface.texcoord_faces),
    )
    if any(len(new) > count[mesh] for _, _, count, new in attributes):
        return
    for values, first, _, new in attributes:
        values[first[mesh] : first[mesh] + len(new)] = new
    for _, _, count, new in attributes[:4]:
        count[mesh] = len(new)
