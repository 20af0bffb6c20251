"""Recordings as they are saved: one file each, on disk as a whole before anything is called saved.

They hold no pictures: those are rendered from a replay when the dataset is written (`write.py`), so that a
person need not wait for them.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.scenario import Pose, Reset, Rollout, ScenarioError, Task
from lerobot_roborecover.utils.atomic_io import atomic_file
from lerobot_roborecover.utils.journal import InUseError, open_locked

SCHEMA_VERSION = 1
MAX_RECORDING_BYTES = 2**28
_FILE = re.compile(r"recording-(\d{6})\.npz")


@dataclass(frozen=True)
class Recorded:
    """One recording of T actions."""

    id: str
    operator: str
    task: Task
    reset: Reset
    actions: np.ndarray
    """(T, A) float64, as executed."""
    bodies: Mapping[str, np.ndarray]
    """(T + 1, 7) float64 by name: position in metres, quaternion xyzw."""
    solved: np.ndarray
    """(T + 1,) bool."""
    mark: tuple[int, str, str] | None
    """The operator's recovery point: step, stage, type; the latter two may be empty."""
    lacks: str
    """Why it is no candidate; empty where it is one."""
    source_record: str
    notes: Mapping[str, Any]
    versions: Mapping[str, str]
    """Versions of the simulator."""

    @property
    def rollout(self) -> Rollout:
        return Rollout(self.task, self.reset, self.actions)


def lacking(mark_step: int | None, solved: np.ndarray, horizon: int) -> str:
    """What keeps a recording from being a candidate, in words; empty where nothing does.

    A policy has `horizon` steps from the recovery point, and so has the proof that it can be recovered from.

    Args:
        mark_step: the recovery point; None where none is marked.
        solved: (T + 1,) bool, the task's own predicate at each step.
        horizon: the task's.
    """
    if mark_step is None:
        return "no recovery point marked"
    if solved[mark_step + 1 : mark_step + 1 + horizon].any():
        return ""
    late = len(solved) - 1 - mark_step > horizon
    return f"not solved {'within the horizon' if late else 'after the mark'}"


class Store:
    """The folder of a dataset's recordings; only one process may hold it.

    Args:
        folder: made if need be.

    Raises:
        ScenarioError: another process has it, or it cannot be written.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        try:
            self._lock = open_locked(folder / ".lock", "a")
        except OSError as err:
            raise ScenarioError(f"{folder} cannot be written: {err}. Name another dataset") from err
        except InUseError:
            raise ScenarioError(
                f"{folder} is in use by another `roborecover curate teleop`; stop that one, or "
                "name another dataset"
            ) from None

    def paths(self) -> list[Path]:
        """Recordings in the order in which they were saved."""
        return [path for _, path in self._numbered()]

    def _numbered(self) -> list[tuple[int, Path]]:
        found = [(_FILE.fullmatch(p.name), p) for p in self.folder.iterdir()]
        return sorted((int(match[1]), path) for match, path in found if match)

    def next_number(self) -> int:
        return max((number for number, _ in self._numbered()), default=0) + 1

    def add(self, recorded: Recorded, number: int) -> Path:
        """Saves a recording; it is on disk when this returns.

        Raises:
            ScenarioError: it could not be written; nothing of it is there.
        """
        path = self.folder / f"recording-{number:06d}.npz"
        try:
            with atomic_file(path) as temporary, open(temporary, "wb") as file:
                _write(file, recorded)
        except OSError as err:
            raise ScenarioError(f"{path} could not be written: {err}. Make room on the disk") from err
        return path

    def close(self) -> None:
        self._lock.close()


def _write(file: io.BufferedWriter, recorded: Recorded) -> None:
    document = {
        "schema_version": SCHEMA_VERSION,
        "id": recorded.id,
        "operator": recorded.operator,
        "task": asdict(recorded.task),
        "reset": asdict(recorded.reset),
        "mark": recorded.mark,
        "lacks": recorded.lacks,
        "source_record": recorded.source_record,
        "notes": dict(recorded.notes),
        "versions": dict(recorded.versions),
        "bodies": list(recorded.bodies),
    }
    np.savez_compressed(
        file,
        document=np.frombuffer(json.dumps(document, allow_nan=False).encode(), np.uint8),
        actions=recorded.actions,
        poses=np.stack(list(recorded.bodies.values())),
        solved=recorded.solved,
    )


def read_recording(path: Path) -> Recorded:
    """A saved recording.

    Raises:
        ScenarioError: the file is not one, or is damaged.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_RECORDING_BYTES:
            raise ValueError(f"{size} bytes unpacked; the limit is {MAX_RECORDING_BYTES}")
        with np.load(path, allow_pickle=False) as arrays:
            document = json.loads(arrays["document"].tobytes())
            actions, poses, solved = (arrays[name] for name in ("actions", "poses", "solved"))
        if document["schema_version"] > SCHEMA_VERSION:
            raise ValueError("schema from the future; upgrade this package")
        fixtures = {
            n: Pose(tuple(p["position_m"]), tuple(p["quat_xyzw"]))
            for n, p in document["reset"]["fixtures"].items()
        }
        reset: dict[str, Any] = {**document["reset"], "fixtures": fixtures}
        mark = document["mark"]
        return Recorded(
            id=document["id"],
            operator=document["operator"],
            task=Task(**document["task"]),
            reset=Reset(**reset),
            actions=actions,
            bodies=dict(zip(document["bodies"], poses, strict=True)),
            solved=solved,
            mark=None if mark is None else (int(mark[0]), mark[1], mark[2]),
            lacks=document["lacks"],
            source_record=document["source_record"],
            notes=document["notes"],
            versions=document["versions"],
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as err:
        raise ScenarioError(
            f"{path} is not a whole recording ({err!s:.200}). Restore it from a copy, or remove it"
        ) from None
