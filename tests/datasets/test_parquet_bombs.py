"""Small parquet files that stand for gigabytes are refused before they are decoded; honest ones are read."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lerobot_roborecover
from lerobot_roborecover.datasets import parquet_bounds, read_scenarios
from lerobot_roborecover.datasets.contents import check_file
from lerobot_roborecover.datasets.episodes import EXACT_ACTION, SCENARIO_INDEX
from lerobot_roborecover.datasets.parquet_read import read_numbers, read_table
from lerobot_roborecover.datasets.schema import FOLDER, RESET_OPTIONS, SCHEMA
from lerobot_roborecover.logs.row import actions_path, read_actions
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_dataset
from tests.support.memory import peak_bytes
from tests.support.scenario_files import parquet_of, refusal, rewrite, seal, set_field

MOST_BYTES = 400 * 2**20
"""Of growth, for a file of some kilobytes: 64 MiB decoded, and what Python makes of it."""
CAMERA = "observation.images.front"


@pytest.fixture
def root(tmp_path):
    return fake_dataset(tmp_path / "set", 4)


def lists(counts, values):
    """A list array of never-null elements."""
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    kind = pa.list_(pa.field("element", values.type, nullable=False))
    return pa.ListArray.from_arrays(pa.array(offsets), values, type=kind)


def empty_poses(count, schema=SCHEMA):
    pose = schema.field("fixtures").type.value_type
    text = pa.StringArray.from_buffers(count, pa.py_buffer(bytes(4 * count + 4)), pa.py_buffer(b""))
    none = lists([0] * count, pa.array([], pa.float64()))
    return pa.StructArray.from_arrays([text, none, none], fields=list(pose))


def put(root, name, column):
    """Writes the scenarios again with one column replaced."""
    table = pq.read_table(parquet_of(root))
    at = table.schema.get_field_index(name)
    columns = [*table.columns[:at], column, *table.columns[at + 1 :]]
    table = pa.Table.from_arrays(columns, schema=SCHEMA)
    pq.write_table(table, parquet_of(root), compression="zstd", use_dictionary=False)
    seal(root)


def read_in_child(call):
    setup = """
from pathlib import Path
from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.candidates import exact_actions
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.datasets.contents import check_file
from lerobot_roborecover.datasets.parquet_read import read_table
from lerobot_roborecover.datasets.trajectories import read_exact
from lerobot_roborecover.datasets.video_frames import read_clips
"""
    return peak_bytes(setup, call)


def is_refused_small(call, path, *words):
    assert path.stat().st_size < 2**19, "it is to be a small file"
    said, grown = read_in_child(call)
    assert said.startswith("ScenarioError: "), said
    assert all(word in said for word in (str(path), *words)), said
    assert grown < MOST_BYTES, f"{grown / 2**20:.0f} MiB"


# --- scenarios


@pytest.mark.slow
def test_millions_of_empty_fixtures_are_refused_small(root):
    put(root, "fixtures", lists([0, 4_000_000, 0, 0], empty_poses(4_000_000)))
    is_refused_small(f"read_scenarios({str(root)!r})", parquet_of(root), "field fixtures", "the limit is")


@pytest.mark.slow
def test_a_provenance_of_millions_of_objects_is_refused_small(root):
    text = '{"a": [' + "{}," * 20_000_000 + "{}]}"
    put(root, "provenance", pa.array(["{}", text, "{}", "{}"]))
    is_refused_small(f"read_scenarios({str(root)!r})", parquet_of(root), "provenance", "the limit is")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("fixtures", lambda: lists([0, 0, 1001, 0], empty_poses(1001)), "reset fixtures: 1001"),
        (
            "provenance",
            lambda: pa.array(["{}", "{}", '{"a": "' + "x" * 2**18 + '"}', "{}"]),
            "provenance bytes of JSON: 262153; the limit is 262144",
        ),
    ],
)
def test_what_is_too_long_is_refused_before_python_sees_it(root, monkeypatch, name, value, words):
    put(root, name, value())
    monkeypatch.setattr(
        "lerobot_roborecover.datasets.read._scenarios", lambda *_: pytest.fail("made Python objects of it")
    )
    message = refusal(root)
    assert "row 2 (scenario " in message
    assert words in message


def test_many_short_objects_are_counted_over_the_whole_file(root, monkeypatch):
    rewrite(root, set_field(2, "provenance", value='{"a": [{}, {}, [], {}]}'))
    assert len(read_scenarios(root)) == 4
    monkeypatch.setattr("lerobot_roborecover.datasets.read.MAX_JSON_CONTAINERS", 0)
    monkeypatch.setattr("lerobot_roborecover.datasets.read.JSON_CONTAINERS_PER_ROW", 1)
    assert "JSON lists and objects; the limit is 4" in refusal(root)


# --- LeRobot's own files


INT64 = pa.int64()


def constant(count, kind=INT64):
    return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(bytes(count * kind.bit_width // 8))])


FRAMES = 20_000_000


def episodes_bomb(root):
    path = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    names = ["episode_index", "length"]
    names += [f"videos/{CAMERA}/{part}" for part in ("chunk_index", "file_index")]
    table = {name: constant(FRAMES // 4) for name in names}
    table |= {
        f"videos/{CAMERA}/{part}": constant(FRAMES // 4, pa.float64())
        for part in ("from_timestamp", "to_timestamp")
    }
    pq.write_table(pa.table(table), path, compression="zstd", write_statistics=False)
    info = {"fps": 10, "features": {CAMERA: {"dtype": "video"}}}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return path


def frames_bomb(root):
    path = root / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    table = {n: constant(FRAMES) for n in ("episode_index", "frame_index", SCENARIO_INDEX)}
    table[EXACT_ACTION] = constant(FRAMES, pa.float64())
    pq.write_table(pa.table(table), path, compression="zstd", write_statistics=False)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "call"),
    [
        (episodes_bomb, "read_clips(Path({root!r}), ['observation.images.front'])"),
        (episodes_bomb, "Videos(Path({root!r}))"),
        (episodes_bomb, "check_file(Path({root!r}), 'meta/episodes/chunk-000/file-000.parquet')"),
        (frames_bomb, "read_exact(Path({root!r}))"),
        (frames_bomb, "exact_actions(Path({root!r}))"),
        (frames_bomb, "check_file(Path({root!r}), 'data/chunk-000/file-000.parquet')"),
    ],
)
def test_run_lengths_that_stand_for_millions_of_rows_are_refused_small(tmp_path, make, call):
    path = make(tmp_path)
    is_refused_small(call.format(root=str(tmp_path)), path, "the limit is")


def repeated_text(path):
    index = pa.array(np.zeros(4000, np.int32))
    pq.write_table(pa.table({"task": pa.DictionaryArray.from_arrays(index, ["x" * 2**20])}), path)


def null_lists_of_a_fixed_size(path):
    claimed = pa.schema([pa.field("task", pa.list_(pa.float64(), 10**6))])
    table = pa.table({"task": pa.array([None] * 1000, pa.list_(pa.float64()))})
    with pq.ParquetWriter(path, table.schema, store_schema=False) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({"ARROW:schema": base64.b64encode(claimed.serialize()).decode()})
    assert pq.read_schema(path).field("task").type.list_size == 10**6


def shared_beginnings(path):
    pq.write_table(
        pa.table({"task": pa.array(["x" * 2**20] * 100)}),
        path, use_dictionary=False, column_encoding={"task": "DELTA_BYTE_ARRAY"},
    )  # fmt: skip


def zeros_in_one_page(path):
    table = pa.table({"task": [bytes(2**27)]})
    pq.write_table(table, path, compression="zstd", use_dictionary=False, write_statistics=False)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (repeated_text, "bytes decoded"),
        (null_lists_of_a_fixed_size, "lists of a fixed size"),
        (shared_beginnings, "encoding"),
        (zeros_in_one_page, "bytes uncompressed"),
    ],
)
def test_other_ways_to_stand_for_gigabytes_are_refused_small(tmp_path, make, words):
    path = tmp_path / "data" / "file-000.parquet"
    path.parent.mkdir()
    make(path)
    is_refused_small(f"read_table(Path({str(path)!r}))", path, words)
    with pytest.raises(ScenarioError, match=words):
        check_file(tmp_path, f"data/{path.name}")


def test_a_footer_that_claims_other_numbers_than_its_pages_is_refused(tmp_path):
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"x": np.arange(12345)}), path)
    data = path.read_bytes()
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    true, lie = (bytes([n << 1 & 127 | 128, n >> 6 & 127 | 128, n >> 13]) for n in (12345, 1000345))
    assert data[footer:].count(true) >= 3
    path.write_bytes(data[:footer] + data[footer:].replace(true, lie))
    with pytest.raises(ScenarioError, match="pages hold 12345 values, the footer says 1000345"):
        read_numbers(path, ["x"])


def test_what_is_no_whole_parquet_is_one_line(tmp_path):
    path = tmp_path / "file.parquet"
    pq.write_table(pa.table({"x": np.arange(100), "text": ["a"] * 100, "none": [None] * 100}), path)
    good = path.read_bytes()
    for columns, words in (
        (["y"], "no column y"),
        (["text"], "not of numbers"),
        (["none"], "column of"),
    ):
        with pytest.raises(ScenarioError, match=words):
            read_numbers(path, columns)
    for data in (b"", b"PAR1", good[:-20], good[: len(good) // 2] + b"PAR1"):
        path.write_bytes(data)
        with pytest.raises(ScenarioError, match=path.name) as caught:
            read_table(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(ScenarioError, match="not a regular file"):
        read_table(tmp_path)


@pytest.mark.slow
def test_json_of_millions_of_lists_is_refused_small(tmp_path):
    path = tmp_path / "meta" / "file.json"
    path.parent.mkdir()
    path.write_text('{"a": [' + "[]," * 20_000_000 + "0]}")
    said, grown = read_in_child(f"check_file(Path({str(tmp_path)!r}), 'meta/file.json')")
    assert "JSON lists and objects; the limit is 4194304" in said
    assert grown < MOST_BYTES


def test_a_trial_s_actions_that_claim_gigabytes_are_refused(tmp_path):
    row = SimpleNamespace(steps=3, trial=0, scenario_id="s", policy="p", actions_sha256="a" * 64)
    path = actions_path(tmp_path, cast(Any, row))
    np.save(path, np.zeros((3, 2), np.float32))
    good = path.read_bytes()
    assert b"(3, 2), }" in good
    path.write_bytes(good.replace(b"(3, 2), }" + b" " * 12, b"(3000000000000, 2), }"))
    with pytest.raises(ScenarioError, match="its actions cannot be read"):
        read_actions(tmp_path, cast(Any, row))


# --- honest files


_numbers = {
    "whole": pa.int64(),
    "small": pa.int8(),
    "real": pa.float32(),
    "yes": pa.bool_(),
    "many": pa.list_(pa.float64()),
    "fixed": pa.list_(pa.float32(), 3),
}


@st.composite
def tables(draw):
    rows = draw(st.integers(0, 60))
    seed, levels = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([1, 3, 1000]))
    rng = np.random.default_rng(seed)
    width = draw(st.integers(0, 5))

    def column(kind):
        if pa.types.is_boolean(kind):
            return rng.integers(0, 2, rows).astype(bool).tolist()
        if pa.types.is_integer(kind):
            return rng.integers(-100, 100, rows).tolist()
        if pa.types.is_floating(kind):
            return rng.integers(0, levels, rows).astype(float).tolist()
        size = width if pa.types.is_list(kind) else kind.list_size
        return rng.integers(0, levels, (rows, size)).astype(float).tolist()

    found = {name: pa.array(column(kind), kind) for name, kind in _numbers.items()}
    words = ["", "a", "reach the handle", None, "é" * 50]
    found["text"] = pa.array([words[i] for i in rng.integers(0, len(words), rows)], pa.string())
    found["bytes"] = pa.array([rng.bytes(levels) for _ in range(rows)], pa.binary())
    found["texts"] = pa.array([words[:n] for n in rng.integers(0, 5, rows)], pa.list_(pa.string()))
    # No list in it: pyarrow itself does not read one back where pages are as small as here.
    struct = pa.struct({"a": pa.float64(), "b": pa.int8()})
    found["struct"] = pa.array([{"a": 1.0, "b": None}] * rows, struct)
    found["none"] = pa.nulls(rows)
    return pa.table(found)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    tables(),
    st.sampled_from(["none", "snappy", "zstd", "gzip", "brotli", "lz4"]),
    st.booleans(),
    st.sampled_from(["1.0", "2.0"]),
    st.integers(1, 70),
    st.sampled_from([64, 2**20]),
)
def test_honest_files_of_every_kind_read_as_they_were_written(
    tmp_path, table, compression, dictionary, pages, group, page_bytes
):
    path = tmp_path / "file.parquet"
    pq.write_table(
        table, path, compression=compression, use_dictionary=dictionary, data_page_version=pages,
        row_group_size=group, data_page_size=page_bytes,
    )  # fmt: skip
    check_file(tmp_path, path.name)
    assert read_table(path).equals(pq.read_table(path))
    for name, array in read_numbers(path, list(_numbers)).items():
        assert array.tolist() == table[name].to_pylist()


@pytest.mark.slow
def test_honest_files_that_compress_well_are_read(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "file.parquet"
    rows = 200_000
    frames = {
        "episode_index": np.repeat(np.arange(rows // 200), 200),
        "frame_index": np.tile(np.arange(200), rows // 200),
        "index": np.arange(rows),
        "timestamp": np.tile(np.arange(200, dtype=np.float32) / 10, rows // 200),
        "task_index": np.zeros(rows, np.int64),
        "action": list(rng.normal(size=(rows, 4)).astype(np.float32)),
        "task": ["reach the handle and turn it"] * rows,
    }
    pq.write_table(pa.table(frames), path, compression="zstd")
    check_file(tmp_path, path.name)
    pictures = [{"bytes": rng.bytes(int(n)), "path": None} for n in rng.integers(500, 9000, 3000)]
    pq.write_table(pa.table({"picture": pictures}), path, row_group_size=300)
    check_file(tmp_path, path.name)
    names = [f"scenario-{i:06d}-of-the-test-split" for i in range(100_000)]
    texts = {f"text {i}": [f"{name} {i}" for name in names[:30_000]] for i in range(4)}
    pq.write_table(pa.table(texts), path, compression="zstd", row_group_size=10_000)
    check_file(tmp_path, path.name)
    pq.write_table(pa.table({"id": names}), path, compression="zstd")
    check_file(tmp_path, path.name)


def test_the_shipped_sets_are_far_from_every_bound(monkeypatch):
    monkeypatch.setattr(parquet_bounds, "SLACK_BYTES", 0)
    found = sorted(Path(lerobot_roborecover.__file__).parent.rglob(f"{FOLDER}/scenarios.parquet"))
    assert found
    for path in found:
        parquet_bounds.check_bounds(path, path.read_bytes(), optional=[RESET_OPTIONS])
