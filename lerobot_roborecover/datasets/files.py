"""Files of a dataset's folder: one that may come from anyone is read, several are changed at one moment.

`read_bytes` is bounded, and takes regular files inside the dataset alone. `update_folder` works as SQLite and
git do:

1. The new files are written to a folder of their own below the root, and are on disk.
2. That folder gets the name `PENDING`: this one rename is the commit. Before it, the dataset is the old one.
3. Each file is moved to its place. Where that is cut short, the next command that reads or writes the dataset
   finishes it (`finish_update`). It can be done any number of times.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import stat
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE, SCENARIOS_FILE
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, check_unlocked, remove_stale, sync_folder
from lerobot_roborecover.utils.file_locks import is_still_at, lock_file
from lerobot_roborecover.utils.journal import open_locked

MAX_JSON_CONTAINERS = 2**22

PENDING = ".roborecover-update"
_LIST, _LOCK = "update.json", f"{PENDING}.lock"
_SCHEMA_VERSION = 1
_MAX_LIST_BYTES = 2**26
_WORK_NAME = re.compile(rf"\.*{re.escape(PENDING)}(\..*)?")


def read_bytes(root: Path, path: Path, limit: int) -> bytes:
    """One file of the dataset, whole.

    Args:
        root: the dataset's folder.
        path: the file, below `root`.
        limit: most bytes it may have.

    Raises:
        ScenarioError: it is missing, unreadable, too large, not a regular file, or a link out of the dataset;
            or an update of the dataset was cut short and cannot be finished.
    """
    finish_update(root)
    try:
        real = path.resolve(strict=True)
        base = root.resolve()
        if base.parent.name == "snapshots" and (base.parent.parent / "blobs").is_dir():
            # huggingface_hub keeps a snapshot's files as links to ../../blobs of the same repository.
            base = base.parent.parent
        if not real.is_relative_to(base):
            raise ScenarioError(
                f"{path} is a link that leaves the dataset, to {real}; put the file itself in its place"
            )
        status = real.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ScenarioError(f"{path} is not a regular file; put the file itself in its place")
        if status.st_size > limit:
            raise ScenarioError(f"{path} has {status.st_size} bytes; the limit is {limit}. Split the dataset")
        with open(real, "rb") as file:
            return file.read(limit)
    except FileNotFoundError:
        raise ScenarioError(
            f"{path} does not exist; a scenario dataset holds {FOLDER}/{MANIFEST_FILE} and "
            f"{FOLDER}/{SCENARIOS_FILE}. Check the path, or write one with write_scenarios"
        ) from None
    except (OSError, RuntimeError) as err:
        raise ScenarioError(f"{path} cannot be read: {err}. Check its permissions and links") from err


def load_json(data: bytes) -> Any:
    """Parses JSON whose lists and objects are counted first: two bytes of text are a hundred of memory.

    Raises:
        ValueError: it is not JSON, or holds too many.
    """
    containers = data.count(b"{") + data.count(b"[")
    if containers > MAX_JSON_CONTAINERS:
        raise ValueError(f"{containers} JSON lists and objects; the limit is {MAX_JSON_CONTAINERS}")
    return json.loads(data)


def what_it_is(data: bytes) -> str:
    """Says what a file that is not what it should be looks like, without reading it as that."""
    head = data[:64].lstrip().lower()
    if not data:
        return "it is empty"
    if data[:1] == b"\x80" and data[1:2] <= b"\x05":
        return "it looks like a Python pickle, which is never loaded"
    if head.startswith((b"<!doctype", b"<html", b"<?xml")):
        return "it looks like a web page, as a failed download leaves behind"
    if head.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer; run `git lfs pull`"
    if data[:4] == b"PAR1":
        return f"it begins like parquet but ends early, after {len(data)} bytes"
    return f"it starts with {data[:16]!r}"


class FolderUpdate:
    """What one update changes.

    Args:
        root: the dataset's folder.
        folder: where the new files are written, under the names that they have below `root`.
    """

    def __init__(self, root: Path, folder: Path):
        self.root, self.folder = root, folder
        self._replaced: set[str] = set()

    def replace_folder(self, name: str) -> None:
        """Removes those files of a folder below the root that the update does not write."""
        self._replaced.add(name)

    def path(self, name: str) -> Path:
        """Returns where a file is read during the update: the new file, or else the one of the root."""
        return self.folder / name if (self.folder / name).exists() else self.root / name

    def changes(self) -> dict[str, list[str]]:
        """Returns the names of the files that are put in place, and of those that are removed."""
        put = _files(self.folder, self.folder)
        there = [n for name in sorted(self._replaced) for n in _files(self.root / name, self.root)]
        return {"put": put, "remove": sorted(set(there) - set(put))}


@contextmanager
def update_folder(root: Path) -> Generator[FolderUpdate]:
    """Changes files of a dataset's folder: all of them when the block ends well, or none.

    Args:
        root: the dataset's folder.

    Raises:
        InUseError: another process updates the dataset, or has locked a file that would be replaced.
        ScenarioError: an earlier update cannot be finished.
    """
    with open_locked(root / _LOCK, "ab"):
        finish_update(root)
        try:
            with atomic_dir(root / PENDING) as folder:
                folder.mkdir()
                update = FolderUpdate(root, folder)
                yield update
                changes = update.changes()
                for name in (*changes["put"], *changes["remove"]):
                    check_unlocked(root / name)
                text = json.dumps({"schema_version": _SCHEMA_VERSION, **changes}, indent=1)
                (folder / _LIST).write_text(text, encoding="utf-8")
                _sync_tree(folder)
            sync_folder(root)
            finish_update(root)
        finally:
            (root / _LOCK).unlink(missing_ok=True)


def finish_update(root: Path) -> None:
    """Finishes an update that a killed process has committed; brings back a folder that was being replaced.

    Raises:
        ScenarioError: it cannot be finished.
    """
    if not os.path.lexists(root):
        remove_stale(root)
        return
    pending = root / PENDING
    try:
        while os.path.lexists(pending):
            with suppress(FileNotFoundError), open(pending / _LIST, "r+b") as file:
                lock_file(file, fcntl.LOCK_EX)
                # Another process may have finished it while this one waited.
                if is_still_at(file, pending / _LIST):
                    _apply(root, pending, _parse(pending / _LIST, file.read(_MAX_LIST_BYTES + 1)))
                continue
            if os.path.lexists(pending) and not (pending / _LIST).exists():
                raise ScenarioError(f"{pending} is no update of this package. Remove it")
    except OSError as err:
        raise ScenarioError(
            f"{root}: an update of this dataset was cut short and cannot be finished: {err}. Run this "
            "command once where the folder can be written"
        ) from err


def is_update_file(name: str) -> bool:
    """Returns whether a name in a dataset's root belongs to an update, and not to the dataset."""
    return _WORK_NAME.fullmatch(name) is not None


def _parse(path: Path, data: bytes) -> dict[str, list[str]]:
    try:
        found = json.loads(data)
        names = {key: [str(name) for name in found[key]] for key in ("put", "remove")}
        known = found["schema_version"] == _SCHEMA_VERSION and len(data) <= _MAX_LIST_BYTES
    except (ValueError, KeyError, TypeError, RecursionError) as err:
        raise ScenarioError(f"{path} is not the list of an update ({err!r:.80}). Remove its folder") from None
    for name in (*names["put"], *names["remove"]):
        if not name or PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ScenarioError(f"{path} names {name[:200]!r}, which leaves the dataset. Remove its folder")
    if not known:
        raise ScenarioError(
            f"{path}, field schema_version: this package reads {_SCHEMA_VERSION}. Upgrade it: pip install -U "
            "lerobot_env_roborecover"
        )
    return names


def _apply(root: Path, pending: Path, changes: dict[str, list[str]]) -> None:
    inside = root.resolve()
    parents = set()
    for name in changes["put"]:
        source, target = pending / name, root / name
        if not source.is_file() or source.is_symlink():
            continue  # moved by the process that was cut short
        if not target.parent.resolve().is_relative_to(inside):
            raise ScenarioError(f"{target} is a link that leaves the dataset; put the folder in its place")
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
        parents.add(target.parent)
    for name in changes["remove"]:
        if not (root / name).parent.resolve().is_relative_to(inside):
            raise ScenarioError(
                f"{root / name} is a link that leaves the dataset; put the folder in its place"
            )
        (root / name).unlink(missing_ok=True)
        parents.add((root / name).parent)
    for folder in sorted(parents, reverse=True):
        if folder.is_dir():
            sync_folder(folder)
            with suppress(OSError):  # not empty
                folder.rmdir()
    # In one rename, so that a finished update is never done again over later changes.
    done = root / f".{PENDING}.{time.time_ns()}.tmp.{os.getpid()}.tmp"
    os.replace(pending, done)
    shutil.rmtree(done, ignore_errors=True)


def _files(folder: Path, root: Path) -> list[str]:
    found = (Path(at) / name for at, _, names in os.walk(folder) for name in names)
    return sorted(path.relative_to(root).as_posix() for path in found)


def _sync_tree(folder: Path) -> None:
    for at, _, names in os.walk(folder, topdown=False):
        for name in names:
            with open(Path(at) / name, "rb") as file:
                os.fsync(file.fileno())
        sync_folder(Path(at))
