"""LIBERO's stored init states, read without torch, and its settling no-ops, recognised in recorded
actions."""

from __future__ import annotations

import pickle
import zipfile
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.libero.assets import package_root
from lerobot_roborecover.platforms.simulator import SimulatorError

_MOST = 10
"""No-ops at the start of an episode (LeRobot and the paper's release)."""


def read_init_states(suite: str, name: str) -> np.ndarray:
    """A task's stored init states, (n, 1 + nq + nv) float64, read without torch.

    They are torch archives of a pickled array; only numpy's own reconstruction is allowed to run.

    Raises:
        SimulatorError: the file is missing or holds something else.
    """
    path = package_root() / "init_files" / suite / f"{name}.pruned_init"
    try:
        with zipfile.ZipFile(path) as archive:
            member = next(n for n in archive.namelist() if n.endswith("data.pkl"))
            with archive.open(member) as file:
                states = _ArrayUnpickler(file).load()
    except (OSError, zipfile.BadZipFile, pickle.UnpicklingError, StopIteration) as err:
        raise SimulatorError(f"cannot read LIBERO's init states {path}: {err}") from err
    states = np.asarray(states)
    if states.ndim != 2 or states.dtype != np.float64:
        raise SimulatorError(f"{path} holds shape {states.shape} of {states.dtype}, not a float64 table")
    return states


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickles numpy arrays and nothing else."""

    _ALLOWED = frozenset(
        {
            ("numpy", "ndarray"),
            ("numpy", "dtype"),
            ("_codecs", "encode"),
            ("numpy.core.multiarray", "_reconstruct"),
            ("numpy._core.multiarray", "_reconstruct"),
        }
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is not part of a numpy array")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def leading_no_ops(actions: np.ndarray) -> int:
    """How many of the first ten actions are no-ops with an open gripper, before the first that is not.

    Args:
        actions: (T, 7) float64.
    """
    still = (actions[:_MOST] == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]).all(axis=1)
    return int(still.argmin()) if not still.all() else len(still)
