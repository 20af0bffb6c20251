"""LIBERO's pictures for people and quick looks on a machine without a GPU: some six times as cheap.

Where the time of a picture goes in software: every face is drawn again for the reflecting floor and once per
shadow, every pixel four times for smooth edges, and more than half of the 200,000 faces are the robot's, most
of them smaller than a pixel. None of that touches the physics: what is drawn is a copy of the model.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np

_CELLS = 40
"""A thinned mesh keeps about so many points along its longest side; at 256 pixels nobody sees the others."""
_FEW_FACES = 500
"""Meshes as small as this stay as they are."""


def light_copy(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of a model to draw from, without shadows and multisampling, with fewer faces.

    Args:
        model: is not touched. Meshes with a texture keep all their faces: thinning tears pictures on them.
    """
    drawn = copy.copy(model)
    drawn.vis.quality.offsamples = drawn.vis.quality.shadowsize = 0
    textured = {
        int(drawn.geom_dataid[geom])
        for geom in range(drawn.ngeom)
        if drawn.geom_matid[geom] >= 0 and (drawn.mat_texid[drawn.geom_matid[geom]] >= 0).any()
    }
    for mesh in range(drawn.nmesh):
        if mesh not in textured and drawn.mesh_facenum[mesh] > _FEW_FACES:
            _thin(drawn, mesh)
    return drawn


def without_reflections(scene: mujoco.MjvScene) -> None:
    """Draws everything once, and no shadows."""
    for flag in (mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_SHADOW):
        scene.flags[flag] = 0


def _thin(model: mujoco.MjModel, mesh: int) -> None:
    """Draws neighbouring points together, and leaves out the faces that have no area then."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[first : first + count]
    low, high = points.min(axis=0), points.max(axis=0)
    cells = np.floor((points - low) / ((high - low).max() / _CELLS + 1e-9)).astype(np.int64)
    _, chosen, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = np.sort(cell.reshape(-1)[model.mesh_face[face : face + faces]], axis=1)
    _, unique = np.unique(corners, axis=0, return_index=True)
    kept = np.sort(unique[(np.diff(corners[unique], axis=1) > 0).all(axis=1)])
    model.mesh_vert[first : first + count] = points[chosen][cell.reshape(-1)]
    for rows in (model.mesh_face, model.mesh_facenormal, model.mesh_facetexcoord):
        rows[face : face + len(kept)] = rows[face : face + faces][kept]
    model.mesh_facenum[mesh] = len(kept)
