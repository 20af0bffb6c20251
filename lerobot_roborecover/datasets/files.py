"""Reads a file of a dataset that may come from anyone: bounded, regular, and inside the dataset."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE, SCENARIOS_FILE
from lerobot_roborecover.datasets.update import finish_update
from lerobot_roborecover.scenario import ScenarioError

MAX_JSON_CONTAINERS = 2**22


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
