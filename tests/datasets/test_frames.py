"""The last frames before the handoff: what is written is what a replay sees, and what lies is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.datasets import frame_files, load_scenarios, write_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.datasets.pictures import stored_frame
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario

CAMERA = "observation.image"


@pytest.fixture(scope="module")
def simulator():
    return make_simulator("fake", obs_type="pixels_agent_pos", observation_size=96)


@pytest.fixture(scope="module")
def scenarios():
    return [fake_scenario(0), fake_scenario(1, steps=3), fake_scenario(2)]


@pytest.fixture
def root(simulator, scenarios, tmp_path):
    frames = (last_frames(simulator, s) for s in scenarios)
    return write_scenarios(tmp_path / "set", scenarios, frames=frames)


def seen(simulator, scenario) -> list[np.ndarray]:
    """The picture of every state of a replay."""
    simulator.reset(scenario.task, scenario.reset)
    pictures = [simulator.render()]
    for action in scenario.prefix:
        simulator.step(action)
        pictures.append(simulator.render())
    return pictures


def test_the_last_five_states_come_back_bit_for_bit(root, simulator, scenarios):
    store = FrameStore(root)
    assert list(store) == [s.id for s in scenarios]
    for scenario, kept in zip(scenarios, (5, 4, 5), strict=True):
        found = store.of(scenario)
        assert found.step == len(scenario.prefix)
        np.testing.assert_array_equal(found.arrays()[CAMERA], seen(simulator, scenario)[-kept:])
    assert (found.arrays()[CAMERA][1:] != found.arrays()[CAMERA][:-1]).any(), "nothing moved"
    np.testing.assert_array_equal(
        stored_frame(root, scenarios, 1, store), store.of(scenarios[1]).arrays()[CAMERA][-1]
    )


def test_evaluation_neither_needs_nor_counts_them(root, scenarios):
    without = write_scenarios(root.with_name("without"), scenarios)
    parquet = "meta/roborecover/scenarios.parquet"
    assert (root / parquet).read_bytes() == (without / parquet).read_bytes()
    (root / "meta/roborecover/frames/file-000.parquet").unlink()
    (root / "meta/roborecover/frames").rmdir()
    assert load_scenarios(root).ids == load_scenarios(without).ids
    assert len(FrameStore(root)) == len(FrameStore(without)) == 0


def test_files_are_closed_at_their_limit_and_read_as_one(simulator, scenarios, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_files, "MAX_FRAMES_BYTES", 20)
    root = write_scenarios(tmp_path, scenarios, frames=(last_frames(simulator, s) for s in scenarios))
    monkeypatch.undo()
    assert len(list((root / "meta/roborecover/frames").iterdir())) == 3
    assert [f.scenario_id for f in FrameStore(root).values()] == [s.id for s in scenarios]


def test_writing_the_set_again_leaves_no_frames_of_the_old_one(root, scenarios):
    write_scenarios(root, scenarios[:2])
    assert not (root / "meta/roborecover/frames").exists()
    assert len(FrameStore(root)) == 0


def test_frames_of_another_prefix_are_not_taken_for_a_scenario_s(root, scenarios):
    other = replace(scenarios[0], prefix=scenarios[0].prefix + 0.1)
    with pytest.raises(ScenarioError, match="of another prefix or reset"):
        FrameStore(root).of(other)
    with pytest.raises(ScenarioError, match="no frames of scenario fake-push-right-007"):
        FrameStore(root).of(fake_scenario(7))


def test_files_that_are_not_those_of_the_manifest_are_refused(root):
    path = root / "meta/roborecover/frames/file-000.parquet"
    path.write_bytes(path.read_bytes()[:-20] + bytes(20))
    with pytest.raises(ScenarioError, match=r"file-000.parquet does not have the SHA-256"):
        FrameStore(root)
    path.unlink()
    with pytest.raises(ScenarioError, match=r"file-000.parquet does not exist"):
        FrameStore(root)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: {CAMERA: (b"\x80\x04pickle",)}, "frame 0 starts with"),
        (lambda f: {CAMERA: f.png[CAMERA] * 7}, "35 frames"),
        (lambda f: {CAMERA: ()}, "0 frames"),
    ],
)
def test_what_is_no_small_number_of_pictures_is_refused_when_written(
    simulator, scenarios, tmp_path, change, words
):
    found = last_frames(simulator, scenarios[0])
    with pytest.raises(ScenarioError, match=words):
        write_scenarios(tmp_path / "set", scenarios, frames=[replace(found, png=change(found))])
    assert not list((tmp_path / "set").rglob("*.parquet"))


def test_a_dictionary_that_stands_for_any_number_of_frames_is_refused(root):
    import hashlib

    import pyarrow.parquet as pq

    path = root / "meta/roborecover/frames/file-000.parquet"
    pq.write_table(pq.read_table(path), path, use_dictionary=True)
    manifest = root / "meta/roborecover/manifest.json"
    said = json.loads(manifest.read_text())
    said["files"]["frames/file-000.parquet"]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest.write_text(json.dumps(said))
    with pytest.raises(ScenarioError, match="without a dictionary"):
        FrameStore(root)
