"""Complete MuJoCo states as arrays, bytes and hashes, and poses of whatever can move.

Works on raw `mujoco.MjModel` / `mujoco.MjData`; LIBERO (robosuite) and Meta-World share it.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable

import mujoco
import numpy as np

from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Pose

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""Everything `mj_step` reads, the solver's warm start included (`mjSTATE_FULLPHYSICS` leaves it out,
and a continuation then differs in the last bits)."""


def save_state(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """The integration state, (n,) float64."""
    state = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state


def load_state(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray) -> None:
    """Puts back what `save_state` gave; derived quantities are stale until the next forward or step.

    Raises:
        SimulatorError: the state is not of this model.
    """
    size = mujoco.mj_stateSize(model, _STATE)
    if state.shape != (size,) or state.dtype != np.float64:
        raise SimulatorError(
            f"a simulator state of shape {state.shape} ({state.dtype}) does not fit this model, which has "
            f"({size},) float64; it was taken from another task or other package versions"
        )
    mujoco.mj_setState(model, data, state, _STATE)


def hash_arrays(*arrays: np.ndarray) -> str:
    """SHA-256 in hex of the arrays' bytes as little-endian float64, in order."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()


def pack_arrays(**arrays: np.ndarray) -> bytes:
    """Named arrays as one npz file in memory."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # ty: ignore[invalid-argument-type] - no array is named `allow_pickle`
    return buffer.getvalue()


def unpack_arrays(packed: bytes) -> dict[str, np.ndarray]:
    """The arrays of `pack_arrays`; never unpickles.

    Raises:
        SimulatorError: the bytes are not such a file.
    """
    try:
        with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, KeyError) as err:
        raise SimulatorError(f"a snapshot of {len(packed)} bytes cannot be read: {err}") from err


def subtree(model: mujoco.MjModel, roots: Iterable[int]) -> set[int]:
    """Ids of the given bodies and of every body below them."""
    found = set(roots)
    for body in range(1, model.nbody):  # MuJoCo numbers parents before children
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return found


def movable_bodies(model: mujoco.MjModel, exclude: Iterable[int] = ()) -> dict[str, int]:
    """Ids by name of the bodies that have a joint of their own.

    Args:
        model: the compiled model.
        exclude: roots of subtrees to leave out, e.g. the robot's base.
    """
    left_out = subtree(model, exclude)
    return {
        model.body(b).name: b
        for b in range(1, model.nbody)
        if model.body_jntnum[b] > 0 and b not in left_out and model.body(b).name
    }


def body_pose(data: mujoco.MjData, body: int) -> Pose:
    """World pose of a body, as of the last forward kinematics."""
    w, x, y, z = data.xquat[body]
    return Pose(tuple(data.xpos[body]), (x, y, z, w))


def site_pose(data: mujoco.MjData, site: int) -> Pose:
    """World pose of a site, as of the last forward kinematics."""
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, data.site_xmat[site])
    w, x, y, z = quat_wxyz
    return Pose(tuple(data.site_xpos[site]), (x, y, z, w))
