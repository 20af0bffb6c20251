"""Checks how long the lists and texts of scenario rows are on Arrow, before Python objects are made of them.

An empty list or an empty JSON object costs next to nothing in a file, and a hundred bytes and more in Python.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lerobot_roborecover.datasets.parquet_read import number_view
from lerobot_roborecover.datasets.schema import (
    MAX_BODIES,
    MAX_FRAMES,
    MAX_PROVENANCE_BYTES,
    MAX_VERSIONS,
    RESET_OPTIONS,
)
from lerobot_roborecover.rollout import MAX_OPTIONS_CHARS
from lerobot_roborecover.scenario import ScenarioError

MAX_JSON_CONTAINERS = 2**20
"""JSON lists and objects in a file's texts, and `JSON_CONTAINERS_PER_ROW` more for every row."""
JSON_CONTAINERS_PER_ROW = 100
_UTF8_BYTES = 4


def check_lengths(batch: pa.RecordBatch) -> None:
    """Checks the lists and texts of scenario rows whose number has a limit.

    Raises:
        ScenarioError: names the row within the batch, the field, the number and the limit.
    """
    mark = batch.column("fingerprint")
    bounded = {
        "provenance bytes of JSON": (batch.column("provenance"), MAX_PROVENANCE_BYTES),
        "reset fixtures": (batch.column("fixtures"), MAX_BODIES),
        "fingerprint bodies": (mark.field("bodies"), MAX_BODIES),
        "fingerprint versions": (mark.field("versions"), MAX_VERSIONS),
        "fingerprint frames_png": (mark.field("frames_png"), MAX_FRAMES),
    }
    if RESET_OPTIONS.name in batch.schema.names:
        options = batch.column(RESET_OPTIONS.name)
        bounded[f"{RESET_OPTIONS.name} bytes of JSON"] = (options, MAX_OPTIONS_CHARS * _UTF8_BYTES)
    for label, (array, limit) in bounded.items():
        lengths = np.diff(_offsets(array))
        longest = int(lengths.argmax())
        if lengths[longest] > limit:
            raise RowTooLongError(longest, f"{label}: {lengths[longest]}; the limit is {limit}")


class RowTooLongError(ScenarioError):
    """A list or text of one row is longer than its limit."""

    def __init__(self, row: int, message: str):
        super().__init__(message)
        self.row = row


def json_containers(batch: pa.RecordBatch) -> int:
    """Returns a bound of the number of lists and objects in the JSON texts of scenario rows."""
    found = 0
    for name in ("provenance", RESET_OPTIONS.name):
        if name in batch.schema.names and (data := batch.column(name).buffers()[2]) is not None:
            offsets = _offsets(batch.column(name))
            text = bytes(memoryview(data)[offsets[0] : offsets[-1]])
            found += text.count(b"{") + text.count(b"[")
    return found


def _offsets(array: pa.Array) -> np.ndarray:
    if isinstance(array, pa.ListArray):
        return number_view(array.offsets)
    return np.frombuffer(array.buffers()[1], np.int32, len(array) + 1, array.offset * 4)
