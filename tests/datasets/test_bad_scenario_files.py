"""Refusals of everything a scenario file can get wrong, by accident or on purpose."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.datasets import parquet_bounds, read_scenarios
from lerobot_roborecover.datasets.schema import FOLDER, SCHEMA, SCHEMA_VERSION
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_dataset
from tests.support.scenario_files import bits, parquet_of, png, refusal, rewrite, seal, set_field


@pytest.fixture
def root(tmp_path):
    return fake_dataset(tmp_path / "set", 4)


def test_the_rewriting_helper_alone_breaks_nothing(root):
    before = [bits(s) for s in read_scenarios(root)]
    rewrite(root, lambda rows: None)
    assert [bits(s) for s in read_scenarios(root)] == before


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_field(2, "prefix", 7, value=float("nan")), ["prefix action 3, dimension 1", "nan", "finite"]),
        (set_field(2, "prefix", 0, value=float("inf")), ["prefix action 0, dimension 0", "inf"]),
        (set_field(2, "prefix", 0, value=1e9), ["1e+09", "limit is 1000"]),
        (
            set_field(2, "prefix", value=[0.0] * 21),
            ["field prefix", "21 numbers", "prefix_steps = 10", "action_dim = 2"],
        ),
        (lambda rows: rows[2].update(prefix_steps=5, action_dim=4), ["width 4", "platform fake takes 2"]),
        (set_field(2, "action_dim", value=0), ["field prefix", "action_dim = 0"]),
        (set_field(2, "action_dim", value=-2), ["field prefix", "action_dim = -2"]),
        (set_field(2, "platform", value="gazebo"), ["platform 'gazebo'", "libero"]),
        (set_field(2, "name", value="../../etc/passwd"), ["task name '../../etc/passwd'", "no path"]),
        (set_field(2, "suite", value="/abs"), ["task suite '/abs'", "no path"]),
        (set_field(2, "id", value="../x"), ["scenario id '../x'"]),
        (set_field(2, "stage", value="Grasp"), ["stage 'Grasp'", "Approach"]),
        (set_field(2, "deviation_type", value="Lost"), ["deviation type 'Lost'", "Wrong Target"]),
        (set_field(2, "source", value="dream"), ["source 'dream'", "natural"]),
        (set_field(2, "horizon", value=0), ["horizon 0"]),
        (set_field(2, "seed", value=-1), ["seed -1"]),
        (set_field(2, "settle_steps", value=11), ["settle_steps 11", "10 actions"]),
        (set_field(2, "provenance", value="{"), ["field provenance", "JSON"]),
        (set_field(2, "provenance", value="[1]"), ["field provenance", "list"]),
        (set_field(2, "provenance", value='{"x": NaN}'), ["field provenance", "NaN"]),
        (set_field(2, "provenance", value='{"x":' + "[" * 5000 + "]" * 5000 + "}"), ["field provenance"]),
        (set_field(2, "sha256", value="0" * 64), ["field sha256", "0" * 64]),
        (set_field(2, "instruction", value="do something else"), ["field sha256"]),
        (set_field(2, "fingerprint", "step", value=9), ["fingerprint is of step 9", "10 actions"]),
        (set_field(2, "fingerprint", "state_sha256", value="zz"), ["field fingerprint", "state_sha256"]),
        (set_field(2, "fingerprint", "bodies", value=[]), ["field fingerprint", "eef"]),
        (
            set_field(2, "fingerprint", "bodies", 0, "position_m", value=[0.0]),
            ["field fingerprint", "3 finite metres"],
        ),
        (
            set_field(2, "fingerprint", "bodies", 0, "quat_xyzw", value=[0.0] * 4),
            ["field fingerprint", "norm 0"],
        ),
        (set_field(2, "fingerprint", "frames_png", value=[b"\x80\x04pickle"]), ["frames_png[0]", "PNG"]),
        (set_field(2, "fingerprint", "frames_png", value=[png()] * 33), ["frames_png", "33", "limit is 32"]),
        (
            lambda rows: rows[2]["fingerprint"]["bodies"].append(rows[2]["fingerprint"]["bodies"][0]),
            ["'eef'", "twice"],
        ),
    ],
)
def test_a_bad_field_is_refused_with_file_row_and_field(root, change, words):
    rewrite(root, change)
    message = refusal(root)
    assert str(parquet_of(root)) in message
    assert "row 2 (scenario " in message
    assert all(word in message for word in words), message


def test_a_duplicate_id_is_refused(root):
    first = read_scenarios(root)[0].id
    rewrite(root, set_field(3, "id", value=first))
    message = refusal(root)
    assert all(word in message for word in (str(parquet_of(root)), "row 3", "field id", first, "row 0")), (
        message
    )


def test_a_truncated_parquet_is_refused(root):
    data = parquet_of(root).read_bytes()
    for keep in (0, 3, len(data) // 2, len(data) - 1):
        parquet_of(root).write_bytes(data[:keep])
        seal(root)
        message = refusal(root)
        assert "not a complete parquet file" in message
        assert ("ends early" if keep > 3 else "empty" if not keep else "starts with") in message


def test_a_pickle_or_a_web_page_in_place_of_parquet_is_refused_and_never_loaded(root, tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    for data, word in (
        (pickle.dumps(Trap()), "pickle"),
        (b"<!DOCTYPE html><html>rate limited</html>", "web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    ):
        parquet_of(root).write_bytes(data)
        seal(root)
        assert word in refusal(root)
    assert not (tmp_path / "sprung").exists()


def test_garbage_between_the_parquet_marks_raises_nothing_but_a_refusal(root):
    rng = np.random.default_rng(0)
    data = parquet_of(root).read_bytes()
    refused = 0
    for _ in range(300):
        broken = bytearray(data)
        for at in rng.integers(4, len(data) - 4, 8):
            broken[at] = rng.integers(256)
        parquet_of(root).write_bytes(broken)
        seal(root)
        try:
            read_scenarios(root)
        except ScenarioError:
            refused += 1
    assert refused > 200


def test_a_changed_byte_is_noticed(root):
    data = bytearray(parquet_of(root).read_bytes())
    data[len(data) // 2] ^= 1
    parquet_of(root).write_bytes(data)
    assert "SHA-256" in refusal(root)


@pytest.mark.parametrize(
    ("version", "words"),
    [
        (SCHEMA_VERSION + 1, ["from the future", str(SCHEMA_VERSION + 1), "pip install -U"]),
        ("1", ["schema_version", "'1'"]),
        (True, ["schema_version", "True"]),
        (None, ["schema_version", "None"]),
    ],
)
def test_a_schema_version_that_is_not_known_is_refused(root, version, words):
    seal(root, schema_version=version)
    message = refusal(root)
    assert all(word in message for word in ("manifest.json", *words)), message


def test_a_manifest_whose_counts_disagree_is_refused(root):
    counts = json.loads((root / FOLDER / "manifest.json").read_text())["counts"]
    for changed, field in (
        ({**counts, "scenarios": 5}, "counts.scenarios"),
        ({**counts, "cell": {}}, "counts.cell"),
        (None, "counts.scenarios"),
    ):
        seal(root, counts=changed)
        assert field in refusal(root)
    seal(root, counts=counts, platform="libero")
    assert "field platform" in refusal(root)


@pytest.mark.parametrize("text", ["", "{", "[]", "NaN", "[" * 100_000, "\x80\x04", '{"schema_version": 1}'])
def test_a_manifest_that_is_not_one_is_refused(root, text):
    (root / FOLDER / "manifest.json").write_bytes(text.encode("latin-1"))
    assert "manifest.json" in refusal(root)


def test_a_manifest_beyond_its_size_limit_is_refused(root):
    (root / FOLDER / "manifest.json").write_bytes(b" " * (2**20 + 1))
    assert "the limit is 1048576" in refusal(root)


def test_columns_that_are_missing_or_of_another_type_are_refused(root):
    table = pq.read_table(parquet_of(root))
    at = table.schema.get_field_index("horizon")
    for changed in (
        table.drop_columns(["horizon"]),
        table.set_column(at, "horizon", table["horizon"].cast(pa.float64())),
        table.set_column(at, pa.field("horizon", pa.int64(), nullable=True), table["horizon"]),
    ):
        pq.write_table(changed, parquet_of(root), use_dictionary=False)
        seal(root)
        assert "field horizon" in refusal(root)


def test_extra_columns_are_ignored(root):
    before = [bits(s) for s in read_scenarios(root)]
    table = pq.read_table(parquet_of(root))
    table = table.append_column("note", pa.array(["x"] * 4))
    pq.write_table(table, parquet_of(root), use_dictionary=False)
    seal(root)
    assert [bits(s) for s in read_scenarios(root)] == before


def test_a_decompression_bomb_is_refused_by_its_page_headers(root, monkeypatch):
    rewrite(root, lambda rows: rows[1].update(provenance='{"x": "' + " " * 200_000 + '"}'))
    assert parquet_of(root).stat().st_size < 50_000
    assert len(read_scenarios(root)) == 4
    monkeypatch.setattr(parquet_bounds, "MAX_UNCOMPRESSED_BYTES", 100_000)
    message = refusal(root)
    assert all(word in message for word in ("bytes uncompressed", "the limit is 100000")), message


def test_a_bomb_whose_footer_lies_about_its_size_is_refused(root, monkeypatch):
    rewrite(root, lambda rows: rows[1].update(provenance='{"x": "' + " " * 200_000 + '"}'))
    column = next(c for c in columns_of(root) if c.path_in_schema == "provenance")
    data = parquet_of(root).read_bytes()
    true, lie = zigzag(column.total_uncompressed_size), zigzag(100)
    # Padded to the same number of bytes, so that nothing else in the file moves.
    lie = bytes([lie[0], lie[1] | 0x80, 0])
    assert len(true) == len(lie)
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    parquet_of(root).write_bytes(data[:footer] + data[footer:].replace(true, lie))
    seal(root)
    assert (
        next(c for c in columns_of(root) if c.path_in_schema == "provenance").total_uncompressed_size == 100
    )
    monkeypatch.setattr(parquet_bounds, "MAX_UNCOMPRESSED_BYTES", 100_000)
    assert "field provenance" in refusal(root)


def columns_of(root: Path) -> list:
    meta = pq.ParquetFile(parquet_of(root)).metadata
    return [meta.row_group(0).column(i) for i in range(meta.num_columns)]


def zigzag(value: int) -> bytes:
    """Thrift's variable-length form of a non-negative integer."""
    value, out = value << 1, bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes(out) + bytes([value])


def test_values_that_a_few_bytes_could_repeat_without_end_are_refused(root, monkeypatch):
    good = parquet_of(root).read_bytes()
    rewrite(root, lambda rows: None, use_dictionary=True)
    assert "without a dictionary" in refusal(root)
    parquet_of(root).write_bytes(good)
    index = SCHEMA.get_field_index("prefix")
    rewrite(
        root, lambda rows: None, SCHEMA.set(index, pa.field("prefix", pa.list_(pa.float64()), nullable=False))
    )
    assert "field prefix" in refusal(root)
    parquet_of(root).write_bytes(good)
    seal(root)
    monkeypatch.setattr(parquet_bounds, "MAX_VALUES", 50)
    assert "values; the limit is 50" in refusal(root)


def test_a_file_beyond_its_size_limit_is_not_read(root, monkeypatch):
    monkeypatch.setattr("lerobot_roborecover.datasets.read.MAX_PARQUET_BYTES", 1000)
    message = refusal(root)
    assert "the limit is 1000" in message
    assert str(parquet_of(root).stat().st_size) in message


def test_links_that_leave_the_dataset_are_refused(root, tmp_path):
    outside = tmp_path / "outside.parquet"
    parquet_of(root).rename(outside)
    parquet_of(root).symlink_to(outside)
    assert "leaves the dataset" in refusal(root)
    outside.rename(root / "inside.parquet")
    parquet_of(root).unlink()
    parquet_of(root).symlink_to("../../inside.parquet")
    assert len(read_scenarios(root)) == 4


def test_links_of_the_hub_cache_are_followed_within_one_repository_only(root, tmp_path):
    snapshot = tmp_path / "datasets--lab--set" / "snapshots" / ("0" * 40)
    blobs = snapshot.parents[1] / "blobs"
    blobs.mkdir(parents=True)
    shutil.copytree(root, snapshot)
    parquet_of(snapshot).rename(blobs / "aa")
    parquet_of(snapshot).symlink_to("../../../../blobs/aa")
    assert len(read_scenarios(snapshot)) == 4
    other = tmp_path / "datasets--lab--other" / "blobs"
    other.mkdir(parents=True)
    (blobs / "aa").rename(other / "aa")
    parquet_of(snapshot).unlink()
    parquet_of(snapshot).symlink_to("../../../../../datasets--lab--other/blobs/aa")
    assert "leaves the dataset" in refusal(snapshot)


def test_a_pipe_or_folder_in_place_of_a_file_is_refused_without_waiting(root):
    parquet_of(root).unlink()
    os.mkfifo(parquet_of(root))
    assert "not a regular file" in refusal(root)
    parquet_of(root).unlink()
    parquet_of(root).mkdir()
    assert "not a regular file" in refusal(root)


def test_a_link_to_itself_is_refused(root):
    parquet_of(root).unlink()
    parquet_of(root).symlink_to(parquet_of(root).name)
    assert "cannot be read" in refusal(root)
