"""Training on a small dataset of numbers without waiting for it.

LeRobot 0.6.1 reads every frame of a LeRobotDataset anew from Arrow, some 2 ms a frame and twice that with
action chunks: half a second for a batch of 128, many times what a small policy takes to learn from it. A
dataset without pictures fits into memory as a few tensors. `lerobot-train` sees the same frames in the same
order either way (a test compares them), only sooner:

    python -m lerobot_roborecover.build.frames_in_memory --config_path=... (arguments of lerobot-train)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np


class FramesInMemory:
    """The numbers of a dataset reader, as tensors.

    Args:
        reader: LeRobot's `DatasetReader` of a dataset without pictures, loaded.
    """

    def __init__(self, reader: Any):
        import torch

        table = reader.hf_dataset.data.table
        self._columns = {name: torch.tensor(table[name].to_pylist()) for name in table.column_names}
        episodes = reader._meta.episodes
        self._bounds = list(zip(episodes["dataset_from_index"], episodes["dataset_to_index"], strict=True))
        self._deltas = {key: np.array(steps) for key, steps in (reader.delta_indices or {}).items()}
        self._tasks = list(reader._meta.tasks.index)
        # Where an episode's frames begin among those that were loaded (all of them, or some episodes').
        loaded = self._columns["index"].numpy()
        self._row_of = np.full(int(loaded.max()) + 1, -1)
        self._row_of[loaded] = np.arange(len(loaded))

    def item(self, row: int) -> dict[str, Any]:
        """What `DatasetReader.get_item(row)` returns."""
        import torch

        item: dict[str, Any] = {name: column[row] for name, column in self._columns.items()}
        first, end = self._bounds[int(item["episode_index"])]
        for key, steps in self._deltas.items():
            wanted = int(item["index"]) + steps
            item[f"{key}_is_pad"] = torch.from_numpy((wanted < first) | (wanted >= end))
            item[key] = self._columns[key][self._row_of[np.clip(wanted, first, end - 1)]]
        item["task"] = self._tasks[int(item["task_index"])]
        return item


@contextmanager
def frames_in_memory() -> Iterator[None]:
    """While it lasts, LeRobot's datasets without pictures answer from memory."""
    from lerobot.datasets.dataset_reader import DatasetReader

    slow = DatasetReader.get_item
    frames: WeakKeyDictionary[Any, FramesInMemory] = WeakKeyDictionary()

    def get_item(reader: Any, row: int) -> dict[str, Any]:
        if reader._meta.camera_keys or reader._image_transforms is not None:
            return slow(reader, row)
        if reader not in frames:
            frames[reader] = FramesInMemory(reader)
        return frames[reader].item(row)

    DatasetReader.get_item = get_item
    try:
        yield
    finally:
        DatasetReader.get_item = slow


def main() -> None:
    """`lerobot-train` with `frames_in_memory`."""
    from lerobot.scripts.lerobot_train import main as lerobot_train

    with frames_in_memory():
        lerobot_train()


if __name__ == "__main__":
    main()
