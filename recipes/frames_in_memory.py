"""Training on a small dataset of numbers and small pictures without waiting for it.

LeRobot 0.6.1 reads every frame of a LeRobotDataset anew from Arrow, some 2 ms a frame and twice that with
action chunks: half a second for a batch of 128, many times what a small policy takes to learn from it. A
dataset of numbers, and of pictures of 64 x 64 that are kept as images, fits into memory as a few tensors.
`lerobot-train` sees the same frames in the same order either way (a test compares them), only sooner:

    python -m recipes.frames_in_memory --config_path=... (as lerobot-train)
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import BytesIO
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np


class FramesBatch(dict[str, Any]):
    """A batch that is collated already."""


class FramesInMemory:
    """The numbers of a dataset reader, as tensors.

    Args:
        reader: LeRobot's `DatasetReader` of a dataset without videos, loaded.
    """

    def __init__(self, reader: Any):
        import torch

        table = reader.hf_dataset.data.table
        pictures = set(reader._meta.image_keys)
        self._columns = {
            name: _pictures(table[name]) if name in pictures else torch.tensor(table[name].to_pylist())
            for name in table.column_names
        }
        self._pictures = pictures
        self._cameras = reader._meta.camera_keys
        episodes = reader._meta.episodes
        self._bounds = np.stack([episodes["dataset_from_index"], episodes["dataset_to_index"]], axis=1)
        self._deltas = {key: np.array(steps) for key, steps in (reader.delta_indices or {}).items()}
        tasks = reader._meta.tasks
        self._tasks = dict(zip(tasks["task_index"].tolist(), tasks.index, strict=True))
        self._transform = reader._image_transforms
        # Where an episode's frames begin among those that were loaded (all of them, or some episodes').
        loaded = self._columns["index"].numpy()
        self._row_of = np.full(int(loaded.max()) + 1, -1)
        self._row_of[loaded] = np.arange(len(loaded))

    def batch(self, rows: list[int]) -> FramesBatch:
        """What PyTorch's collation makes of `DatasetReader.get_item` of each of the rows."""
        import torch

        batch = FramesBatch({name: column[rows] for name, column in self._columns.items()})
        index, bounds = batch["index"].numpy(), self._bounds[batch["episode_index"].numpy()]
        for key, steps in self._deltas.items():
            wanted = index[:, None] + steps
            first, end = bounds[:, :1], bounds[:, 1:]
            batch[f"{key}_is_pad"] = torch.from_numpy((wanted < first) | (wanted >= end))
            batch[key] = self._columns[key][self._row_of[np.clip(wanted, first, end - 1)]]
        for key in self._pictures:
            batch[key] = batch[key].float() / 255
        if self._transform is not None:
            # As LeRobot: each frame by itself, its cameras one after the other.
            for row in range(len(rows)):
                for key in self._cameras:
                    batch[key][row] = self._transform(batch[key][row])
        batch["task"] = [self._tasks[task] for task in batch["task_index"].tolist()]
        return batch


def _pictures(column: Any) -> Any:
    """(N, 3, H, W) uint8 of a column of encoded images."""
    import torch
    from PIL import Image

    def decoded(cell: Any) -> np.ndarray:
        return np.asarray(Image.open(BytesIO(cell["bytes"].as_py()))).transpose(2, 0, 1)

    with ThreadPoolExecutor() as pool:
        return torch.from_numpy(np.stack(list(pool.map(decoded, column, chunksize=64))))


@contextmanager
def frames_in_memory() -> Iterator[None]:
    """While it lasts, data loaders get whole batches of LeRobot's datasets without videos from memory."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from torch.utils.data._utils.collate import default_collate_fn_map

    frames: WeakKeyDictionary[Any, FramesInMemory] = WeakKeyDictionary()

    def getitems(dataset: Any, rows: list[int]) -> list[Any]:
        if dataset.meta.video_keys or dataset.meta.has_language_columns:
            return [dataset[row] for row in rows]
        if dataset not in frames:
            frames[dataset] = FramesInMemory(dataset.reader)
        return [frames[dataset].batch(rows)]

    LeRobotDataset.__getitems__ = getitems
    default_collate_fn_map[FramesBatch] = lambda batches, collate_fn_map: dict(batches[0])
    try:
        yield
    finally:
        del LeRobotDataset.__getitems__, default_collate_fn_map[FramesBatch]


def main() -> None:
    """`lerobot-train` with `frames_in_memory`."""
    from lerobot.scripts.lerobot_train import main as lerobot_train

    with frames_in_memory():
        lerobot_train()


if __name__ == "__main__":
    main()
