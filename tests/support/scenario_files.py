"""What tests of scenario files share: comparing bit by bit, and tampering with a set as a stranger could."""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.datasets.schema import FOLDER, SCHEMA
from lerobot_roborecover.scenario import Scenario, ScenarioError


def png(width: int = 2, height: int = 2) -> bytes:
    """The start of a PNG: signature and header chunk."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


def bits(scenario: Scenario) -> tuple:
    """Everything of a scenario in a form in which equal means bit-identical, -0.0 distinguished from 0.0."""
    mark, reset = scenario.fingerprint, scenario.reset
    return (
        scenario.id,
        scenario.task,
        repr(reset),
        scenario.prefix.shape,
        scenario.prefix.tobytes(),
        (scenario.stage, scenario.deviation, scenario.source, scenario.source_policy),
        (scenario.split, scenario.cluster),
        repr(scenario.provenance),
        repr(mark),
        mark and mark.frames_png,
    )


def parquet_of(root: Path) -> Path:
    return root / FOLDER / "scenarios.parquet"


def seal(root: Path, **changes) -> None:
    """Makes the manifest agree with the parquet again, as who tampers with it would; applies changes."""
    path = root / FOLDER / "manifest.json"
    manifest = json.loads(path.read_text())
    data = parquet_of(root).read_bytes()
    manifest["files"]["scenarios.parquet"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    path.write_text(json.dumps(manifest | changes))


def rewrite(root: Path, change, schema: pa.Schema = SCHEMA, **options) -> None:
    """Applies `change` to the list of rows and writes them back with a matching manifest."""
    rows = pq.read_table(parquet_of(root)).to_pylist()
    change(rows)
    options = {"compression": "zstd", "use_dictionary": False} | options
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), parquet_of(root), **options)
    seal(root)


def set_field(row: int, *path, value):
    """A change of one field, nested names and list positions as `path`."""

    def change(rows):
        target = rows[row]
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value

    return change


def refusal(root: Path) -> str:
    with pytest.raises(ScenarioError) as caught:
        read_scenarios(root)
    return str(caught.value)
