"""Reads arrays from HDF5 files that may come from anyone: bounded, and never from another file."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_roborecover.scenario import ScenarioError

if TYPE_CHECKING:
    import h5py

MAX_ARRAY_BYTES = 2**33


@contextmanager
def open_hdf5(path: Path) -> Generator[h5py.File]:
    """An HDF5 file, opened for reading.

    Raises:
        ScenarioError: h5py is missing, or the file is not HDF5.
    """
    try:
        import h5py
    except ModuleNotFoundError:
        raise ScenarioError("HDF5 files need h5py, which is not installed: pip install h5py") from None
    try:
        file = h5py.File(path, "r")
    except OSError as err:
        raise ScenarioError(f"{path} cannot be opened as HDF5: {str(err)[:200]}") from None
    with file:
        yield file


def read_array(
    group: h5py.Group,
    name: str,
    *,
    ndim: int | None = None,
    width: int | None = None,
    rows: tuple[int, str] | None = None,
) -> np.ndarray:
    """An array below a group, whole.

    Args:
        group: of an open file.
        name: path below it.
        ndim: number of axes it must have.
        width: length its last axis must have.
        rows: how many there must be, and of what there are as many.

    Raises:
        ScenarioError: it is missing, lies in another file, is too large or of another shape, or is not
            numeric.
    """
    import h5py

    where, node = _find(group, name)
    if not isinstance(node, h5py.Dataset) or node.external or node.is_virtual:
        raise ScenarioError(f"{where} is not an array in the file itself")
    if node.nbytes > MAX_ARRAY_BYTES:
        raise ScenarioError(f"{where} has {node.nbytes} bytes; the limit is {MAX_ARRAY_BYTES}")
    if node.dtype.kind not in "fiuS":
        raise ScenarioError(f"{where} is of {node.dtype}, not of numbers or bytes")
    if (ndim is not None and node.ndim != ndim) or (width is not None and node.shape[-1:] != (width,)):
        raise ScenarioError(
            f"{where} has shape {node.shape}; expected {ndim} axes, the last of {width or 'any'}"
        )
    if rows is not None and node.shape[:1] != rows[:1]:
        raise ScenarioError(
            f"{where} has {node.shape[0] if node.shape else 'no'} rows, but there are {rows[0]} {rows[1]}: "
            "which belongs to which is not known. Take the file from its source again"
        )
    try:
        values = node[()]
    except (OSError, RuntimeError, MemoryError) as err:
        raise ScenarioError(
            f"{where} cannot be read: {str(err)[:200]}. Take the file from its source again"
        ) from None
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise ScenarioError(f"{where} holds NaN or infinity; record it again")
    return values


def read_group(group: h5py.Group, name: str, why: str = "") -> h5py.Group:
    """Returns a group below a group.

    Args:
        group: of an open file.
        name: path below it.
        why: what a file without it is, and the remedy.

    Raises:
        ScenarioError: it is missing, lies in another file, or is no group.
    """
    import h5py

    where, node = _find(group, name, why)
    if not isinstance(node, h5py.Group):
        raise ScenarioError(f"{where} is not a group. Take the file from its source again")
    return node


def _find(group: h5py.Group, name: str, why: str = "") -> tuple[str, Any]:
    """Returns where a node is, for messages, and the node itself."""
    import h5py

    where = f"{group.file.filename}: {group.name.rstrip('/')}/{name}"
    node = group
    for part in name.split("/"):
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if isinstance(link, h5py.ExternalLink):
            raise ScenarioError(f"{where} is a link to another file; only the file itself is read")
        node = node.get(part) if link is not None else None
        if node is None:
            raise ScenarioError(f"{where} is missing{why and f': {why}'}")
    return where, node


def episode_names(group: h5py.Group, prefix: str) -> list[str]:
    """Names like `demo_0`, in numeric order."""
    names = [n for n in group if n.startswith(prefix) and n[len(prefix) :].isdigit()]
    return sorted(names, key=lambda n: int(n[len(prefix) :]))
