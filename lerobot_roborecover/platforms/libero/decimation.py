"""Meshes with fewer faces, their normals and texture coordinates carried over, and a cache of them on disk.

The edges are collapsed by the library fast-simplification (Garland and Heckbert's quadric error metric). It
knows positions alone, so each corner of a new face looks its normal and texture coordinates up on the
original surface: at the nearest place that faces the same way and, so that no triangle reaches across the
texture picture, is near on it: in the same chart (a piece on which it is continuous), on one side of a seam.
"""

from __future__ import annotations

import hashlib
import zipfile
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.utils.atomic_io import atomic_file

_VERSION = "1"
"""Of what `decimate` makes; another one leaves the cache's entries unread."""
_ATTEMPTS = ((0.0, True), (0.0, False), (1 / 400, False), (1 / 200, False), (1 / 100, False))
"""One after the other, until few enough faces are left: cells within which points are made one, in longest
sides of the mesh, and whether borders stay where they are. They should, for neighbouring meshes begin there;
but a mesh of many loose pieces, as some of LIBERO's are, cannot be decimated before its pieces are joined."""
_ENOUGH = 1.25
"""Times the faces wanted."""
_SAMPLES = 30_000
"""Places on an original surface, about, at which attributes are looked up."""
_TURN = 0.03
"""What facing another way counts in the search, in longest sides per unit of normal: so the two sides of a
bowl's wall are farther apart than it is thick."""
_CHART = 10.0
"""Distance between charts in that search, in longest sides: beyond any other."""
_PICTURE = 0.1
"""What being elsewhere on the texture picture counts in it, of the distance that it is on the surface.
Little, but the other side of a seam within a chart, as on a can's label, is farther away so."""
_INWARD = 0.1
"""How far inside of a face, of the way to its middle, the normals of its corners are looked up: a large face
would else get those of the rounded edge that was left out around it."""
_CREASE_COS = 0.87
"""Cosine of what a corner's normal may differ from its face's, 30 degrees; beyond it is the face's own."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, its attributes indexed separately, as in MuJoCo's model."""

    points: np.ndarray
    """(V, 3) float32."""
    faces: np.ndarray
    """(F, 3) int32 rows of `points`."""
    normals: np.ndarray
    """(N, 3) float32."""
    normal_faces: np.ndarray
    """(F, 3) int32 rows of `normals`."""
    texcoords: np.ndarray
    """(T, 2) float32; T is 0 without."""
    texcoord_faces: np.ndarray
    """(F, 3) int32 rows of `texcoords`; (0, 3) without."""


def cached_decimation(surface: Surface, faces: int, folder: Path) -> Surface:
    """`decimate`, or what it once made of the same surface.

    Args:
        surface: the original.
        faces: see `decimate`.
        folder: of the cache. Processes may share it; an entry that cannot be read is made anew.

    Raises:
        SimulatorError: the package fast-simplification is missing.
    """
    path = folder / f"{_key(surface, faces)}.npz"
    try:
        with np.load(path) as entry:
            return Surface(*(entry[field.name] for field in fields(Surface)))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        made = decimate(surface, faces)
    # Without a writable cache, as in some containers, it is made at every load.
    with suppress(OSError), atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **{field.name: getattr(made, field.name) for field in fields(Surface)})
    return made


def decimate(surface: Surface, faces: int) -> Surface:
    """A surface of about so many faces within the same bounds, or the same one if none can be left out.

    Raises:
        SimulatorError: the package fast-simplification is missing.
    """
    simplify = _library().simplify
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    side = max(float((high - low).max()), 1e-9)
    # The library's thresholds are absolute: it gets the mesh with a longest side of 1.
    scaled = (surface.points - low).astype(np.float64) / side
    for cell, preserve_border in _ATTEMPTS:
        points, corners = _welded(scaled, surface.faces, cell)
        if len(corners) > faces:
            points, corners = simplify(points, corners, target_count=faces, preserve_border=preserve_border)
        if len(corners) <= _ENOUGH * faces:
            break
    turned, area = _face_normals(points[corners])
    corners, turned = corners[area > 0], turned[area > 0]
    if not 0 < len(corners) < len(surface.faces):
        return surface
    original = _Attributes(surface, scaled)
    normals, normal_faces = _indexed(original.normals(points[corners], turned), 2)
    texcoords, texcoord_faces = surface.texcoords, surface.texcoord_faces
    if len(texcoords):
        texcoords, texcoord_faces = _indexed(original.texcoords(points[corners], turned), 4)
    placed = np.clip(points * side + low, low, high).astype(np.float32)
    return Surface(placed, corners.astype(np.int32), normals, normal_faces, texcoords, texcoord_faces)


class _Attributes:
    """Normals and texture coordinates near a surface.

    Args:
        surface: the original.
        points: (V, 3) float64, its points with a longest side of 1, as all positions here.
    """

    def __init__(self, surface: Surface, points: np.ndarray):
        self._surface, self._corners = surface, points[surface.faces]
        turned, area = _face_normals(self._corners)
        count = np.clip(np.ceil(area / max(area.sum(), 1e-30) * _SAMPLES).astype(int), 1, 256)
        face = np.repeat(np.arange(len(area)), count)
        nth = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
        weights = _spread(nth)
        places = np.einsum("sc,scx->sx", weights, self._corners[face])
        spots = np.hstack([places, _TURN * turned[face]])
        self._face, self._painted = face, np.zeros((len(face), 0))
        if len(surface.texcoords):
            painted = surface.texcoords.astype(np.float64)[surface.texcoord_faces]
            _, used = _face_normals(np.pad(painted, ((0, 0), (0, 0), (0, 1))))
            painted *= _PICTURE * np.sqrt(area.sum() / max(used.sum(), 1e-9))
            self._painted = np.hstack(
                [_CHART * _charts(surface)[face, None], np.einsum("sc,scx->sx", weights, painted[face])]
            )
        self._anywhere, self._near = KDTree(spots), KDTree(np.hstack([spots, self._painted]))

    def normals(self, corners: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """(F, 3, 3) unit normals for the corners (F, 3, 3) of new faces with normals `turned` (F, 3)."""
        middles = corners.mean(axis=1, keepdims=True)
        surface = self._surface
        normals = self._at(
            corners + _INWARD * (middles - corners), turned, surface.normals, surface.normal_faces
        )
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
        creased = np.einsum("fcx,fx->fc", normals, turned) < _CREASE_COS
        return np.where(creased[..., None], turned[:, None], normals)

    def texcoords(self, corners: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """(F, 3, 2), as `normals`."""
        return self._at(corners, turned, self._surface.texcoords, self._surface.texcoord_faces)

    def _at(
        self, places: np.ndarray, turned: np.ndarray, values: np.ndarray, value_faces: np.ndarray
    ) -> np.ndarray:
        """(F, 3, n) values interpolated at (F, 3, 3) places, each face's from one piece of the texture."""
        _, nearest = self._anywhere.query(np.hstack([places.mean(axis=1), _TURN * turned]))
        spots = np.hstack([_TURN * turned, self._painted[nearest]])
        _, nearest = self._near.query(np.hstack([places.reshape(-1, 3), np.repeat(spots, 3, axis=0)]))
        face = self._face[nearest]
        weights = _barycentric(places.reshape(-1, 3), self._corners[face])
        return np.einsum("sc,scx->sx", weights, values[value_faces[face]]).reshape(len(places), 3, -1)


def _welded(points: np.ndarray, faces: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Makes one of all points in a cell, equal ones at least, and leaves out faces that have no area then.

    Args:
        points: (V, 3) float64.
        faces: (F, 3).
        cell: its side; 0 welds equal points alone.

    Returns:
        (v, 3) float64 points and (f, 3) int32 faces.
    """
    _, index, shared = np.unique(
        np.floor(points / cell) if cell else points, axis=0, return_inverse=True, return_counts=True
    )
    index = index.reshape(-1)
    middles = np.stack([np.bincount(index, column) for column in points.T], axis=1) / shared[:, None]
    corners = index[faces].astype(np.int32)
    a, b, c = corners.T
    return middles, np.ascontiguousarray(corners[(a != b) & (b != c) & (c != a)])


def _charts(surface: Surface) -> np.ndarray:
    """(F,) the chart of each face: faces are joined where they share a point with its texture coordinates."""
    places = surface.points[surface.faces].reshape(-1, 3)
    painted = np.hstack([places, surface.texcoords[surface.texcoord_faces].reshape(-1, 2)])
    unique, corner = np.unique(painted, axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3)
    pairs = np.vstack([corner[:, :2], corner[:, 1:]])
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(unique), len(unique)))
    _, chart = connected_components(graph, directed=False)
    return chart[corner[:, 0]]


def _spread(nth: np.ndarray) -> np.ndarray:
    """(S, 3) barycentric coordinates of the n-th place on a triangle: its middle, then evenly spread."""
    first, second = 0.7548776662466927, 0.5698402909980532  # Roberts's R2 sequence
    u, v = (1 / 3 + nth * first) % 1.0, (1 / 3 + nth * second) % 1.0
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return np.stack([1 - u - v, u, v], axis=1)


def _barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(S, 3) weights of the corners of (S, 3, 3) triangles for points above them, none negative."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    offset = points - triangles[:, 0]
    a, b, c = (np.einsum("sx,sx->s", x, y) for x, y in ((first, first), (first, second), (second, second)))
    d, e = (np.einsum("sx,sx->s", offset, x) for x in (first, second))
    area = np.maximum(a * c - b * b, 1e-18)
    u, v = (c * d - b * e) / area, (a * e - b * d) / area
    weights = np.clip(np.stack([1 - u - v, u, v], axis=1), 0, None)
    return weights / weights.sum(axis=1, keepdims=True)


def _face_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of faces (F, 3, 3): (F, 3) unit normals, zero where there is no area, and (F,) areas."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    return normals / np.maximum(length, 1e-30)[:, None], length / 2


def _indexed(rows: np.ndarray, decimals: int) -> tuple[np.ndarray, np.ndarray]:
    """The distinct ones of (F, 3, n) rows, rounded, float32; and (F, 3) int32 where each of them is."""
    rounded = rows.reshape(-1, rows.shape[-1]).round(decimals).astype(np.float32)
    distinct, index = np.unique(rounded, axis=0, return_inverse=True)
    return distinct, index.reshape(-1, 3).astype(np.int32)


def _key(surface: Surface, faces: int) -> str:
    digest = hashlib.sha256(f"{_VERSION} {_library().__version__} {faces}".encode())
    for array in astuple(surface):
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array))
    return digest.hexdigest()[:32]


def _library() -> ModuleType:
    try:
        import fast_simplification
    except ModuleNotFoundError as err:
        raise SimulatorError(
            "render_quality=fast on LIBERO needs the package fast-simplification: install "
            "fast-simplification==0.2.0, which comes with the extra `libero`"
        ) from err
    return fast_simplification
