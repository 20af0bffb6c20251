"""LeRobotDataset (v3.0) folders of numbers, written without LeRobot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

STEPS = 4


def lerobot_folder(root: Path, tasks: Sequence[str], *, action: int = 4, camera: str = "") -> Path:
    """Writes a dataset in which episode i is of task i, each of `STEPS` frames whose actions are all i.

    Args:
        root: the new folder.
        tasks: instructions by `task_index`.
        action: width of the actions.
        camera: name of a camera whose video is an empty file.
    """

    def feature(dtype: str, *shape: int) -> dict:
        return {"dtype": dtype, "shape": shape, "names": None}

    features = {
        "observation.state": feature("float32", 2), "action": feature("float32", action),
        "timestamp": feature("float32", 1), "frame_index": feature("int64", 1),
        "episode_index": feature("int64", 1), "index": feature("int64", 1), "task_index": feature("int64", 1),
    }  # fmt: skip
    count = len(tasks)
    episode = np.repeat(np.arange(count), STEPS)
    step = np.tile(np.arange(STEPS), count)
    table = {
        "observation.state": _vectors(episode, 2), "action": _vectors(episode, action),
        "timestamp": pa.array(step / 10, pa.float32()), "frame_index": pa.array(step),
        "episode_index": pa.array(episode), "index": pa.array(np.arange(len(step))),
        "task_index": pa.array(episode),
    }  # fmt: skip
    episodes = {
        "episode_index": range(count), "tasks": [[t] for t in tasks], "length": [STEPS] * count,
        "data/chunk_index": [0] * count, "data/file_index": [0] * count,
        "dataset_from_index": range(0, count * STEPS, STEPS),
        "dataset_to_index": range(STEPS, (count + 1) * STEPS, STEPS),
    }  # fmt: skip
    if camera:
        features[camera] = feature("video", 8, 8, 3)
        episodes |= {f"videos/{camera}/{part}_index": [0] * count for part in ("chunk", "file")}
        _new(root / "videos" / camera / "chunk-000" / "file-000.mp4").touch()
    info = {
        "codebase_version": "v3.0", "fps": 10, "features": features, "total_episodes": count,
        "total_frames": len(step), "total_tasks": count, "robot_type": None,
    }  # fmt: skip
    _new(root / "meta" / "info.json").write_text(json.dumps(info))
    write_tasks(root, tasks, range(count))
    for name, columns in (("meta/episodes", episodes), ("data", table)):
        pq.write_table(
            pa.table({k: list(v) if isinstance(v, range) else v for k, v in columns.items()}),
            _new(root / name / "chunk-000" / "file-000.parquet"),
        )
    return root


def write_tasks(root: Path, tasks: Sequence[str], index: Sequence[int]) -> None:
    """Writes `tasks.parquet`: instructions and their `task_index`, in the order given, as pandas does."""
    import pandas as pd

    frame = pd.DataFrame({"task_index": list(index)}, index=pd.Index(list(tasks), name="task"))
    frame.to_parquet(_new(root / "meta" / "tasks.parquet"))


def _vectors(values: np.ndarray, width: int) -> pa.Array:
    return pa.array(np.repeat(values[:, None], width, axis=1).tolist(), pa.list_(pa.float32()))


def _new(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
