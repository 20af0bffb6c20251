"""Files and folders that appear whole, on disk, or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_roborecover.scenario import ScenarioError


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A name beside `path`; what the block writes there takes its place when the block ends well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        _to_disk(temporary)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    # The name is only there after a crash once its folder is on disk, too.
    _to_disk(path.parent)


def write_whole(path: Path, data: str | bytes) -> None:
    """Writes a file, text as UTF-8; it is on disk when this returns."""
    with new_file(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def check_new(root: Path) -> None:
    """Checks that a folder can be written: that it does not exist, or is empty.

    Raises:
        ScenarioError: it is not.
    """
    if root.is_symlink() or (root.exists() and (not root.is_dir() or any(root.iterdir()))):
        raise ScenarioError(f"{root} is not an empty folder; name a new one")


@contextmanager
def new_folder(root: Path, *, replace: bool = False) -> Iterator[Path]:
    """A name beside `root`, not made yet, whose folder takes root's place when the block ends well.

    Args:
        root: where it belongs.
        replace: whether it may take the place of an earlier folder, which is deleted then.

    Raises:
        ScenarioError: `root` is not new or empty, and must be.
    """
    if not replace:
        check_new(root)
    root.parent.mkdir(parents=True, exist_ok=True)
    temporary, old = (root.with_name(f".{root.name}.{os.getpid()}.{kind}") for kind in ("tmp", "old"))
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        yield temporary
        if root.exists() and not replace:
            root.rmdir()
        elif root.exists():
            os.replace(root, old)
        try:
            os.replace(temporary, root)
        except BaseException:
            if old.exists():
                os.replace(old, root)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
