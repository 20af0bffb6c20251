"""Scenario sets: bit-exact round trips, what writing refuses, and loading."""

from __future__ import annotations

import hashlib
import importlib.resources
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_roborecover.datasets import load_scenarios, read_scenarios, write_scenarios
from lerobot_roborecover.datasets.load import builtin_names
from lerobot_roborecover.datasets.schema import FOLDER, MAX_PROVENANCE_BYTES, SCHEMA_VERSION
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import (
    DeviationType,
    Fingerprint,
    Pose,
    Reset,
    Rollout,
    Scenario,
    ScenarioError,
    Source,
    Stage,
    Task,
)
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.scenario_files import bits, png

FLOAT = st.floats(-1000, 1000, allow_subnormal=True)
NAMES = st.text(st.characters(codec="utf-8", categories=("L", "N", "P")), min_size=1, max_size=12)
TEXT = st.text(st.characters(codec="utf-8"), max_size=30)
POSES = st.builds(
    Pose, st.tuples(FLOAT, FLOAT, FLOAT), st.sampled_from([(0.0, -0.0, 0.0, 1.0), (0.6, 0.0, -0.8, 5e-324)])
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=6,
)


@st.composite
def scenarios(draw, platform="libero", width=7):
    prefix = draw(arrays(np.float64, st.tuples(st.integers(0, 5), st.just(width)), elements=FLOAT))
    fingerprint = draw(
        st.none()
        | st.builds(
            Fingerprint,
            step=st.just(len(prefix)),
            bodies=st.dictionaries(NAMES, POSES, max_size=3).map(
                lambda d: {"eef": Pose((0, 0, 0), (0, 0, 0, 1)), **d}
            ),
            state_sha256=st.sampled_from(["", "0f" * 32]),
            versions=st.dictionaries(NAMES, NAMES, max_size=3),
            frames_png=st.lists(st.binary(max_size=40).map(lambda tail: png() + tail), max_size=3).map(tuple),
        )
    )
    whole = st.none() | st.integers(0, 2**32 - 1)
    return Scenario(
        id=draw(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,20}", fullmatch=True)),
        task=Task(
            platform,
            "libero_goal",
            "open the drawer (1)",
            draw(TEXT.filter(bool)),
            draw(st.integers(1, 1000)),
        ),
        reset=Reset(
            draw(whole),
            draw(whole),
            draw(st.integers(0, len(prefix))),
            draw(st.dictionaries(NAMES, POSES, max_size=3)),
        ),
        prefix=prefix,
        stage=draw(st.sampled_from(Stage)),
        deviation=draw(st.sampled_from(DeviationType)),
        source=draw(st.sampled_from(Source)),
        source_policy=draw(NAMES),
        split=draw(st.sampled_from(["train", "test"])),
        cluster=draw(NAMES | st.just("")),
        provenance=draw(st.dictionaries(TEXT, JSON, max_size=3)),
        fingerprint=fingerprint,
    )


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(scenarios(), min_size=1, max_size=4, unique_by=lambda s: s.id))
def test_round_trip_is_bit_exact(tmp_path, written):
    read = read_scenarios(write_scenarios(tmp_path, written))
    assert [bits(s) for s in read] == [bits(s) for s in written]
    assert [s.sha256() for s in read] == [s.sha256() for s in written]


def test_subnormal_and_negative_zero_actions_survive(tmp_path):
    prefix = np.array([[5e-324, -0.0, 1.0000000000000002, -1e3, 0.1, 2.2e-308, 1e-17]])
    scenario = Scenario(
        "x",
        Task("libero", "s", "t", "do", 9),
        Reset(),
        prefix,
        Stage.MOVE,
        DeviationType.WRONG_POSE,
        Source.HUMAN,
    )
    (read,) = read_scenarios(write_scenarios(tmp_path, [scenario]))
    assert read.prefix.tobytes() == prefix.tobytes()
    assert read.prefix.dtype == np.float64
    assert not read.prefix.flags.writeable


def test_many_scenarios_keep_their_order_across_row_groups(tmp_path):
    one = fake_scenario(0)
    written = [replace(one, id=f"s{i:03d}", provenance={"i": i}) for i in range(200)]
    read = read_scenarios(write_scenarios(tmp_path, written))
    assert [(s.id, s.provenance["i"]) for s in read] == [(f"s{i:03d}", i) for i in range(200)]


def test_writing_refuses_what_it_could_not_read_back(tmp_path):
    one, two = fake_scenario(0), fake_scenario(1)
    other = Scenario(
        "m",
        Task("metaworld", "s", "t", "d", 9),
        Reset(),
        np.zeros((1, 4)),
        "Move",
        "Wrong Pose",
        "human",
    )
    for bad, words in (
        ([], ["no scenarios"]),
        ([one, two, one], ["row 2", "field id", one.id, "row 0"]),
        ([one, other], ["row 1", "field platform", "'metaworld'", "'fake'"]),
        ([replace(one, provenance={"x": float("nan")})], [one.id, "provenance", "JSON"]),
        ([replace(one, provenance={"x": {1, 2}})], [one.id, "provenance", "JSON"]),
        (
            [replace(one, provenance={"x": "a" * MAX_PROVENANCE_BYTES})],
            ["provenance", str(MAX_PROVENANCE_BYTES)],
        ),
        ([replace(one, source_policy="a\nb")], [one.id, "source_policy", "printable"]),
        ([replace(one, cluster="a" * 300)], [one.id, "cluster", "256"]),
        ([replace(one, provenance={"x": "\ud800"})], ["Unicode"]),
        ([with_frames(one, b"GIF89a" + bytes(40))], [one.id, "frames_png[0]", "PNG"]),
        ([with_frames(one, png(), png(100_000, 2))], ["frames_png[1]", "100000 x 2", "4096"]),
    ):
        with pytest.raises(ScenarioError) as caught:
            write_scenarios(tmp_path / "set", bad)
        assert all(word in str(caught.value) for word in words), str(caught.value)
    assert not list(tmp_path.rglob("*.*"))


def with_frames(scenario: Scenario, *frames: bytes) -> Scenario:
    return replace(scenario, fingerprint=replace(scenario.fingerprint, frames_png=frames))


def test_a_write_that_fails_leaves_the_old_set_as_it_was(tmp_path):
    fake_dataset(tmp_path, 3)
    before = {p: p.read_bytes() for p in (tmp_path / FOLDER).iterdir()}
    bad = [
        replace(fake_scenario(i), id=f"s{i}", provenance={"x": object()} if i == 99 else {})
        for i in range(100)
    ]
    with pytest.raises(ScenarioError, match="provenance"):
        write_scenarios(tmp_path, bad)
    assert {p: p.read_bytes() for p in (tmp_path / FOLDER).iterdir()} == before


def test_a_write_stopped_between_its_two_files_is_refused_when_read(tmp_path):
    fake_dataset(tmp_path / "old", 3)
    fake_dataset(tmp_path / "new", 4)
    shutil.copy(tmp_path / "new" / FOLDER / "scenarios.parquet", tmp_path / "old" / FOLDER)
    with pytest.raises(ScenarioError, match=r"SHA-256.*not of one writing"):
        read_scenarios(tmp_path / "old")


def test_the_manifest_tells_what_is_inside(tmp_path):
    write_scenarios(tmp_path, [fake_scenario(i) for i in range(4)], description="four", license="CC-BY-4.0")
    manifest = json.loads((tmp_path / FOLDER / "manifest.json").read_text())
    data = (tmp_path / FOLDER / "scenarios.parquet").read_bytes()
    assert manifest["schema_version"] == SCHEMA_VERSION
    assert manifest["platform"] == "fake"
    assert (manifest["description"], manifest["license"]) == ("four", "CC-BY-4.0")
    assert manifest["versions"] == {"fake": ["1"]}
    assert manifest["counts"]["scenarios"] == 4
    assert manifest["counts"]["source"] == {"natural": 2, "perturbed": 2}
    assert manifest["counts"]["cell"]["Approach-Wrong Pose"] == 2
    entry = manifest["files"]["scenarios.parquet"]
    assert entry == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


@pytest.fixture
def root(tmp_path):
    return fake_dataset(tmp_path / "set", 4)


def test_loading_a_folder(root, monkeypatch):
    found = load_scenarios(root)
    assert (found.source, found.revision, found.platform) == (str(root), None, "fake")
    assert list(found.ids) == [s.id for s in read_scenarios(root)]
    monkeypatch.chdir(root.parent)
    assert load_scenarios(root.name).ids == found.ids


@pytest.mark.parametrize(
    ("source", "options", "words"),
    [
        ("no/such/folder", {}, ["neither a folder", "built-in", "org/name"]),
        ("no_such_set", {}, ["neither a folder"]),
        ("set", {"revision": "v1"}, ["no revision 'v1'"]),
        ("set", {"split": "train"}, ["no split 'train'", "'test': 4"]),
        ("set", {"select": "suite=nothing"}, ["suite=nothing", "toy (4)"]),
        (".", {}, ["manifest.json does not exist", "write_scenarios"]),
    ],
)
def test_what_cannot_be_loaded_says_what_there_is(root, monkeypatch, source, options, words):
    monkeypatch.chdir(root.parent)
    with pytest.raises(ScenarioError) as caught:
        load_scenarios(source, **options)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_built_in_name_comes_before_a_folder_of_that_name(tmp_path, monkeypatch, caplog):
    fake_dataset(tmp_path / "package" / "data" / "toy_starter", 2)
    (tmp_path / "package" / "data" / "notes").mkdir()
    fake_dataset(tmp_path / "here" / "toy_starter", 3)
    fake_dataset(tmp_path / "policies" / "study" / "toy_study" / "scenarios", 1)
    monkeypatch.setattr(importlib.resources, "files", lambda package: tmp_path / "package")
    monkeypatch.chdir(tmp_path / "here")
    assert builtin_names() == ["toy_starter", "toy_study"], "a clone has its studies' sets, too"
    assert len(load_scenarios("toy_study")) == 1
    found = load_scenarios("toy_starter")
    assert (len(found), found.source, found.revision) == (2, "toy_starter", None)
    assert "./toy_starter" in caplog.text
    assert len(load_scenarios("./toy_starter")) == 3
    assert len(load_scenarios(Path("toy_starter"))) == 3
    with pytest.raises(ScenarioError, match="built-in set, which has no revision 'v1'"):
        load_scenarios("toy_starter", revision="v1")


def test_a_split_is_kept_alone(tmp_path):
    write_scenarios(tmp_path, [replace(fake_scenario(i), split=("train", "test")[i % 2]) for i in range(4)])
    assert {s.split for s in load_scenarios(tmp_path, split="train")} == {"train"}
    assert len(load_scenarios(tmp_path)) == 4


def test_importing_and_reading_bring_neither_lerobot_nor_torch_nor_the_hub_client(root):
    code = (
        "import sys; import lerobot_roborecover.datasets as d\n"
        "heavy = {'lerobot', 'torch', 'huggingface_hub', 'pandas'}\n"
        "assert not heavy & set(sys.modules) and 'pyarrow' not in sys.modules\n"
        f"assert len(d.load_scenarios({str(root)!r})) == 4\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    subprocess.run([sys.executable, "-c", code], check=True, env=env)


def test_options_of_a_reset_are_kept_in_a_dataset(tmp_path):
    (task,) = platform_named("lerobot_pusht").tasks()
    reset = Reset(seed=1, options={"reset_to_state": [100.0, 100.0, 250.0, 250.0, 0.5]})
    plain = Rollout(task, Reset(seed=1), np.full((3, 2), 200.0))
    made = Scenario(
        "one", task, reset, plain.actions, stage=Stage.MOVE, deviation=DeviationType.WRONG_POSE,
        source=Source.NATURAL,
    )  # fmt: skip
    assert made.sha256() != plain.sha256()
    write_scenarios(tmp_path / "set", [made], description="of a test")
    (back,) = read_scenarios(tmp_path / "set")
    assert back.reset.options == reset.options
    assert back.sha256() == made.sha256()
