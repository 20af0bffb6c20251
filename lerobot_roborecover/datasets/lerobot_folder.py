"""Opens a local LeRobotDataset (v3.0) folder, and never the network.

Where LeRobot finds a folder not whole, it downloads the repository id that it was given *into that folder*,
over the user's recording. So a folder is checked before LeRobot sees it, and the id that LeRobot gets
(`local_repo_id`) is none that the Hub can have. LeRobot also takes tasks by their row in `tasks.parquet`
instead of by `task_index`; the rows are put in order. LeRobot is imported only when a dataset is opened.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.files import read_bytes, what_it_is
from lerobot_roborecover.scenario import ScenarioError

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

MAX_INFO_BYTES = 2**24
MAX_TASKS = 2**17
MAX_EPISODES = 2**22
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_BATCH = 2**16
_FETCH = "Fetch or record the dataset again"
_CONVERT = (
    "Convert a copy of it: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/copy "
    "--root=COPY --push-to-hub=false"
)


@dataclass(frozen=True)
class LeRobotFolder:
    """What a checked LeRobotDataset folder says of itself."""

    root: Path
    features: dict[str, dict[str, Any]]
    tasks: tuple[str, ...]
    """Instructions by `task_index`."""
    tasks_in_order: bool
    """Whether the rows of `tasks.parquet` are in that order, too."""
    lengths: tuple[int, ...]
    """Frames by episode."""


def local_repo_id(root: Path) -> str:
    """Returns the name that LeRobot gets for a local folder; the Hub's client refuses to ask for it."""
    return f"local:{root.resolve()}"


def open_lerobot_folder(root: Path) -> LeRobotDataset:
    """Checks a local dataset folder and opens it without the network; its tasks are in order of `task_index`.

    Raises:
        ScenarioError: the folder is no whole LeRobotDataset of format v3.0.
    """
    found = check_lerobot_folder(root)

    import pandas as pd
    from datasets.exceptions import DatasetsError
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    try:
        dataset = LeRobotDataset(local_repo_id(root), root=root)
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException, DatasetsError) as err:
        cause = err.__cause__ or err
        raise ScenarioError(f"{root} cannot be opened by LeRobot: {_one_line(cause)}. {_FETCH}") from err
    index = pd.Index(found.tasks, name="task")
    dataset.meta.tasks = pd.DataFrame({"task_index": range(len(found.tasks))}, index=index)
    return dataset


def check_lerobot_folder(root: Path) -> LeRobotFolder:
    """Checks that a folder holds all of a LeRobotDataset (v3.0): format, tasks, episodes, data and videos.

    Raises:
        ScenarioError: names the file, what is wrong with it, and the remedy.
    """
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise ScenarioError(f"{root} has no meta/info.json; name the folder of a LeRobotDataset (v3.0)")
    data = read_bytes(root, path, MAX_INFO_BYTES)
    try:
        info = json.loads(data)
        version, features = str(info["codebase_version"]), info["features"]
        _check_version(root, version)
        episodes, frames = info["total_episodes"], info["total_frames"]
        if not (type(episodes) is int and 0 < episodes <= MAX_EPISODES and type(frames) is int):
            raise ValueError(f"total_episodes {episodes!r:.40}, total_frames {frames!r:.40}")
        for name, feature in features.items():
            if not isinstance(feature["dtype"], str) or not all(type(n) is int for n in feature["shape"]):
                raise ValueError(f"feature {name!r:.80}: {feature!r:.80}")
        for key, wanted in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
            if info.get(key) not in (None, wanted):
                raise ValueError(f"{key} {info[key]!r:.80} is not {wanted!r}")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        if isinstance(err, ScenarioError):
            raise
        raise ScenarioError(f"{path} is not LeRobot's ({err!r:.200}): {what_it_is(data)}. {_FETCH}") from None
    tasks, map_ordered = _read_tasks(root)
    lengths, files = _read_episodes(root, episodes, [k for k, f in features.items() if f["dtype"] == "video"])
    for name in sorted(files):
        if not (root / name).is_file():
            raise ScenarioError(f"{root} has no {name}, which meta/episodes names. {_FETCH}")
    _check_data(root, features, lengths, len(tasks))
    if sum(lengths) != frames:
        raise ScenarioError(f"{path}: total_frames is {frames}, meta/episodes has {sum(lengths)}. {_FETCH}")
    return LeRobotFolder(root, features, tasks, map_ordered, tuple(lengths))


def _check_version(root: Path, version: str) -> None:
    numbers = re.fullmatch(r"v?(\d{1,4})\.(\d{1,4})(\.\d{1,4})*", version)
    if numbers is None:
        raise ValueError(f"codebase_version {version!r:.40}")
    if int(numbers[1]) == 3:
        return
    remedy = "Upgrade this package: pip install -U lerobot_env_roborecover"
    if int(numbers[1]) < 3:
        remedy = _CONVERT if numbers[0].removeprefix("v") == "2.1" else _FETCH + " in v3.0"
    raise ScenarioError(f"{root} is a LeRobotDataset of format {version}; v3.0 is read. {remedy}")


def _read_tasks(root: Path) -> tuple[tuple[str, ...], bool]:
    """Returns the instructions by `task_index`, and whether the rows are in that order."""
    path = root / "meta" / "tasks.parquet"
    with _parquet(path) as file:
        names = file.schema_arrow.names
        # pandas names an index without a name so; LeRobot's converter from v2.1 leaves it like that.
        text = next((n for n in ("task", "__index_level_0__") if n in names), None)
        if text is None or "task_index" not in names or not 0 < file.metadata.num_rows <= MAX_TASKS:
            raise ScenarioError(
                f"{path} has the columns {names!s:.200} and {file.metadata.num_rows} rows; it needs task and "
                f"task_index, and 1 to {MAX_TASKS} rows. {_FETCH}"
            )
        columns = file.read([text, "task_index"]).to_pydict()
    by_index = dict(zip(columns["task_index"], columns[text], strict=True))
    missing = next((i for i in range(len(columns[text])) if i not in by_index), None)
    if missing is not None:
        raise ScenarioError(
            f"{path} has no task_index {missing} among its {len(columns[text])} tasks; LeRobot needs 0 "
            "to N-1, each once. Number the tasks anew, in the data's task_index too"
        )
    instructions = tuple(by_index[i] for i in range(len(by_index)))
    if not all(isinstance(t, str) for t in instructions):
        raise ScenarioError(f"{path}: column {text} is not text. {_FETCH}")
    return instructions, columns["task_index"] == list(range(len(instructions)))


def _read_episodes(root: Path, count: int, cameras: list[str]) -> tuple[list[int], set[str]]:
    """Returns the frames of each episode, and the files that hold them."""
    folder = root / "meta" / "episodes"
    places = [("data", DATA_PATH), *((f"videos/{c}", VIDEO_PATH) for c in cameras)]
    parts = [f"{prefix}/{part}_index" for prefix, _ in places for part in ("chunk", "file")]
    lengths: dict[int, int] = {}
    files = set()
    for path in _parquet_files(folder):
        for batch in _batches(path, ["episode_index", "length", *parts]):
            for row in batch.to_pylist():
                episode, length = row["episode_index"], row["length"]
                if not all(type(v) is int and v >= 0 for v in row.values()) or not length:
                    raise ScenarioError(f"{path}: {row!s:.200} is no episode. {_FETCH}")
                if episode in lengths or episode >= count:
                    raise ScenarioError(
                        f"{path}: episode_index {episode} is there twice, or is not one of the {count} of "
                        f"meta/info.json. {_FETCH}"
                    )
                lengths[episode] = length
                for (prefix, pattern), camera in zip(places, ["", *cameras], strict=True):
                    chunk, file = (row[f"{prefix}/{part}_index"] for part in ("chunk", "file"))
                    files.add(pattern.format(chunk_index=chunk, file_index=file, video_key=camera))
    missing = next((i for i in range(count) if i not in lengths), None)
    if missing is not None:
        raise ScenarioError(
            f"{folder} has no episode {missing}; meta/info.json has {count} episodes. {_FETCH}"
        )
    return [lengths[i] for i in range(count)], files


def _check_data(root: Path, features: dict[str, Any], lengths: list[int], tasks: int) -> None:
    wanted = {name for name, feature in features.items() if feature["dtype"] != "video"}
    seen = np.zeros(len(lengths), np.int64)
    for path in _parquet_files(root / "data"):
        with _parquet(path) as file:
            names = set(file.schema_arrow.names)
        if names != wanted:
            missing, more = sorted(wanted - names), sorted(names - wanted)
            raise ScenarioError(
                f"{path} and meta/info.json name different columns: the file lacks {missing!s:.200} and has "
                f"{more!s:.200} besides. Give them the same names, or record the dataset again"
            )
        for batch in _batches(path, ["episode_index", "task_index"]):
            for name, count in (("episode_index", len(lengths)), ("task_index", tasks)):
                values = _integers(path, name, batch.column(name))
                if len(values) and not 0 <= values.min() <= values.max() < count:
                    raise ScenarioError(
                        f"{path}: column {name} goes from {values.min()} to {values.max()}, meta/ "
                        f"names 0 to {count - 1}. Number them alike, or fetch or record the dataset again"
                    )
                if name == "episode_index":
                    seen += np.bincount(values, minlength=len(lengths))
    for episode, length in enumerate(lengths):
        if seen[episode] != length:
            raise ScenarioError(
                f"{root}/data has {seen[episode]} frames of episode {episode}, meta/episodes has {length}. "
                f"{_FETCH}"
            )


def _parquet_files(folder: Path) -> list[Path]:
    """Returns the files that LeRobot reads, in its order."""
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        raise ScenarioError(f"{folder} has no chunk-*/file-*.parquet. {_FETCH}")
    return paths


def _parquet(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise ScenarioError(f"{path} does not exist. {_FETCH}") from None
    except (OSError, ValueError, pa.ArrowException) as err:
        raise ScenarioError(f"{path} cannot be read as parquet: {_one_line(err)}. {_FETCH}") from None


def _batches(path: Path, columns: list[str]) -> Iterator[pa.RecordBatch]:
    """Yields some columns of a file, a bounded number of rows at a time."""
    with _parquet(path) as file:
        missing = sorted(set(columns) - set(file.schema_arrow.names))
        if missing:
            raise ScenarioError(f"{path} has no column {missing[0]}. {_FETCH}")
        try:
            yield from file.iter_batches(_BATCH, columns=columns)
        except (OSError, pa.ArrowException) as err:
            raise ScenarioError(f"{path} cannot be read: {_one_line(err)}. {_FETCH}") from None


def _integers(path: Path, name: str, column: pa.Array) -> np.ndarray:
    """Returns a column of one whole number a row, bare or in lists of one."""
    values = column.flatten() if pa.types.is_nested(column.type) else column
    if not pa.types.is_integer(values.type) or values.null_count or len(values) != len(column):
        raise ScenarioError(f"{path}: column {name} is not one whole number a row. {_FETCH}")
    return values.to_numpy(zero_copy_only=False).astype(np.int64)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
