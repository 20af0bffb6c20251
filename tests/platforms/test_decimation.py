from __future__ import annotations

import sys

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero import decimation
from lerobot_roborecover.platforms.libero.decimation import Surface, cached_decimation, decimate
from lerobot_roborecover.platforms.simulator import SimulatorError

pytest.importorskip("fast_simplification")

RADII = np.array([0.05, 0.03, 0.08])


@pytest.fixture
def egg() -> Surface:
    """An ellipsoid of 3,840 faces, its texture a map in degrees with a seam at 0 = 360."""
    east, south = np.meshgrid(np.arange(61) * 6.0, np.linspace(0, 180, 33))
    phi, theta = np.radians(east % 360).ravel(), np.radians(south).ravel()
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    normals = ball / RADII
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    a = np.arange(32 * 61).reshape(32, 61)[:, :-1].ravel()
    faces = np.vstack([np.stack([a, a + 61, a + 62], axis=1), np.stack([a, a + 62, a + 1], axis=1)])
    faces = faces.astype(np.int32)
    texcoords = np.stack([east.ravel(), south.ravel()], axis=1).astype(np.float32)
    return Surface(
        (ball * RADII).astype(np.float32), faces, normals.astype(np.float32), faces, texcoords, faces
    )


def arrays(surface: Surface) -> list[np.ndarray]:
    return list(vars(surface).values())


def test_fewer_faces_keep_bounds_normals_and_texture(egg):
    made = decimate(egg, 500)
    assert 100 < len(made.faces) <= 1.25 * 500
    assert len(made.faces) == len(made.normal_faces) == len(made.texcoord_faces)
    low, high = made.points.min(axis=0), made.points.max(axis=0)
    assert (low >= egg.points.min(axis=0)).all()
    assert (high <= egg.points.max(axis=0)).all()
    np.testing.assert_allclose(high - low, 2 * RADII, rtol=0.05)

    corners = made.points[made.faces].reshape(-1, 3)
    normals = made.normals[made.normal_faces].reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=0.02)
    outward = corners / RADII**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.median((normals * outward).sum(axis=1)) > 0.97
    assert ((normals * outward).sum(axis=1) > 0.5).mean() > 0.99

    south = np.degrees(np.arccos(np.clip((corners / RADII)[:, 2], -1, 1)))
    painted = made.texcoords[made.texcoord_faces]
    assert np.percentile(np.abs(painted.reshape(-1, 2)[:, 1] - south), 95) < 12
    away = np.abs(south.reshape(-1, 3) - 90).max(axis=1) < 60
    assert np.ptp(painted[away, :, 0], axis=1).max() < 90, "no face reaches across the seam"


def test_a_mesh_without_texture_or_of_loose_faces_is_decimated_too(egg):
    none = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32)
    plain = Surface(egg.points, egg.faces, egg.normals, egg.normal_faces, *none)
    made = decimate(plain, 300)
    assert len(made.faces) <= 1.25 * 300
    assert len(made.texcoords) == len(made.texcoord_faces) == 0

    apart = np.random.default_rng(0).normal(scale=1e-6, size=(len(egg.faces) * 3, 3))
    points = (egg.points[egg.faces].reshape(-1, 3) + apart).astype(np.float32)
    loose = Surface(
        points, np.arange(len(points), dtype=np.int32).reshape(-1, 3), egg.normals, egg.normal_faces, *none
    )
    assert len(decimate(loose, 300).faces) <= 1.25 * 300


def test_what_cannot_be_decimated_stays(egg):
    one = egg.faces[60:61]
    triangle = Surface(egg.points, one, egg.normals, one, egg.texcoords, one)
    assert decimate(triangle, 1) is triangle
    flat = Surface(egg.points * 0, egg.faces, egg.normals, egg.faces, egg.texcoords, egg.faces)
    assert decimate(flat, 100) is flat


def test_the_cache_gives_the_same_arrays_and_makes_unreadable_entries_anew(egg, tmp_path, monkeypatch):
    folder = tmp_path / "a" / "meshes"
    made = cached_decimation(egg, 400, folder)
    (entry,) = folder.iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(decimation, "decimate", lambda *_: pytest.fail("a cached mesh was made again"))
        again = cached_decimation(egg, 400, folder)
    assert all(
        np.array_equal(x, y) and x.dtype == y.dtype for x, y in zip(arrays(made), arrays(again), strict=True)
    )
    whole = entry.read_bytes()
    for damaged in (b"", b"no archive", whole[: len(whole) // 2], whole[:200] + b"\0" * 64 + whole[264:]):
        entry.write_bytes(damaged)
        again = cached_decimation(egg, 400, folder)
        assert all(np.array_equal(x, y) for x, y in zip(arrays(made), arrays(again), strict=True))
        assert entry.read_bytes() == whole
    cached_decimation(egg, 500, folder)
    assert len(list(folder.iterdir())) == 2, "another number of faces, another entry; no temporary files"


def test_without_a_writable_cache_the_mesh_is_made(egg, tmp_path):
    (tmp_path / "file").touch()
    assert len(cached_decimation(egg, 400, tmp_path / "file" / "meshes").faces) <= 500


def test_the_missing_package_is_named(egg, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(SimulatorError, match=r"fast-simplification==0\.2\.0.*extra `libero`"):
        cached_decimation(egg, 400, tmp_path)
