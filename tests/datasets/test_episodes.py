"""Scenarios as a LeRobotDataset: prefixes as episodes, exact actions, and links back to the scenarios."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.episodes import (
    EXACT_ACTION,
    SCENARIO_INDEX,
    render_prefix,
    to_frame,
)
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.frames import camera_pictures, last_frames
from lerobot_roborecover.datasets.write import write_episodes, write_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import ScenarioError
from tests.support.factories import fake_scenario

pytestmark = pytest.mark.lerobot


def camera():
    return make_simulator("fake", obs_type="pixels_agent_pos", observation_size=96)


@pytest.fixture(scope="module")
def scenarios():
    return [fake_scenario(0, steps=7), fake_scenario(1, steps=12)]


@pytest.fixture(scope="module")
def written(scenarios, tmp_path_factory):
    return write_episodes(tmp_path_factory.mktemp("out") / "set", scenarios, camera, description="two")


@pytest.fixture(scope="module")
def dataset(written):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("lab/set", root=written)


def test_lerobot_reads_one_episode_per_scenario(dataset, scenarios):
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 19, 20)
    simulator = camera()
    frames = [frame for s in scenarios for frame in render_prefix(simulator, s)]
    assert len(frames) == 19
    for i in (0, 6, 7, 18):
        item = dataset[i]
        assert item["task"] == scenarios[i >= 7].task.instruction
        np.testing.assert_array_equal(item["observation.state"], frames[i]["observation.state"])
        np.testing.assert_array_equal(
            item["observation.environment_state"], frames[i]["observation.environment_state"]
        )
        seen = item["observation.image"].numpy().transpose(1, 2, 0) * 255
        assert frames[i]["observation.image"].dtype == np.uint8
        # The video is lossy; a frame of another step would differ by far more around the mass.
        assert np.abs(seen - frames[i]["observation.image"]).mean() < 4


def test_actions_are_exact_and_every_frame_names_its_scenario(written, dataset, scenarios):
    (path,) = (written / "data").rglob("*.parquet")
    table = pq.read_table(path)
    exact = np.array(table[EXACT_ACTION].to_pylist(), dtype=np.float64)
    assert exact.tobytes() == np.concatenate([s.prefix for s in scenarios]).tobytes()
    assert [int(i) for i in table[SCENARIO_INDEX].to_pylist()] == [0] * 7 + [1] * 12
    np.testing.assert_array_equal(np.array(table["action"].to_pylist(), np.float32), exact.astype(np.float32))


def test_the_columns_of_our_own_are_no_policy_features(dataset):
    from lerobot.utils.feature_utils import dataset_to_policy_features

    assert {EXACT_ACTION, SCENARIO_INDEX} <= set(dataset.features)
    assert set(dataset_to_policy_features(dataset.features)) == {
        "observation.image",
        "observation.state",
        "observation.environment_state",
        "action",
    }


def test_the_same_folder_is_a_scenario_set(written, scenarios):
    found = load_scenarios(written)
    assert [s.sha256() for s in found] == [s.sha256() for s in scenarios]
    assert found.manifest["description"] == "two"


def test_a_frame_is_the_observation_before_its_action(scenarios):
    simulator = camera()
    frames = list(render_prefix(simulator, scenarios[0]))
    reached = simulator.state_sha256()
    assert len(frames) == len(scenarios[0].prefix)
    assert reached == scenarios[0].fingerprint.state_sha256
    simulator.reset(scenarios[0].task, scenarios[0].reset)
    first = simulator.observe()
    np.testing.assert_array_equal(frames[0]["observation.image"], first["pixels"])
    np.testing.assert_array_equal(frames[0]["observation.state"], first["agent_pos"].astype(np.float32))


def test_libero_frames_are_upright_and_have_lerobot_s_names():
    rng = np.random.default_rng(0)
    images = {key: rng.integers(0, 256, (16, 16, 3), dtype=np.uint8) for key in ("image", "image2")}
    robot = {
        "eef": {"pos": np.array([0.1, 0.2, 0.3]), "quat": np.array([0.0, 0.0, 0.0, 1.0]), "mat": np.eye(3)},
        "gripper": {"qpos": np.array([0.4, -0.4]), "qvel": np.zeros(2)},
        "joints": {"pos": np.zeros(7), "vel": np.zeros(7)},
    }
    frame = to_frame("libero", {"pixels": images, "robot_state": robot})
    assert set(frame) == {"observation.images.image", "observation.images.image2", "observation.state"}
    np.testing.assert_array_equal(frame["observation.images.image"], images["image"][::-1, ::-1])
    np.testing.assert_allclose(frame["observation.state"], [0.1, 0.2, 0.3, 0, 0, 0, 0.4, -0.4], atol=1e-7)
    assert frame["observation.state"].dtype == np.float32


@pytest.mark.parametrize("platform", ["libero", "robotwin", "metaworld"])
def test_cameras_are_those_of_lerobot_s_own_processors(platform):
    rng = np.random.default_rng(0)
    names = {"libero": ("image", "image2"), "robotwin": ("head_camera", "left_camera")}.get(platform)
    images = [rng.integers(0, 256, (16, 24, 3), dtype=np.uint8) for _ in range(2)]
    observation = {"pixels": dict(zip(names, images, strict=True)) if names else images[0]}
    if platform == "libero":
        eef = {"pos": np.zeros(3), "quat": np.array([0.0, 0, 0, 1]), "mat": np.eye(3)}
        joints = {"pos": np.zeros(7), "vel": np.zeros(7)}
        gripper = {"qpos": np.zeros(2), "qvel": np.zeros(2)}
        observation["robot_state"] = {"eef": eef, "gripper": gripper, "joints": joints}
    else:
        observation["agent_pos"] = np.zeros(4, np.float32)
    ours, theirs = camera_pictures(platform, observation), to_frame(platform, observation)
    assert set(ours) == {key for key in theirs if "image" in key}
    for key, picture in ours.items():
        np.testing.assert_array_equal(picture, theirs[key])


def test_the_last_frames_are_kept_without_loss_and_end_at_the_recovery_point(written, scenarios):
    store = FrameStore(written)
    simulator = camera()
    for scenario in scenarios:
        found = store.of(scenario)
        assert found == last_frames(simulator, scenario)
        (pictures,) = found.arrays().values()
        hand_off(simulator, scenario)
        np.testing.assert_array_equal(pictures[-1], simulator.render())
        frames = list(render_prefix(simulator, scenario))
        np.testing.assert_array_equal(pictures[:-1], [f["observation.image"] for f in frames[-4:]])


def test_a_write_that_cannot_be_complete_leaves_nothing(scenarios, tmp_path):
    simulator = camera()
    frames = [list(render_prefix(simulator, s)) for s in scenarios]
    reset = replace(scenarios[0].reset, settle_steps=0)
    empty = replace(scenarios[0], id="empty", prefix=np.zeros((0, 2)), reset=reset, fingerprint=None)
    for some, episodes, fps, words in (
        (scenarios, [frames[0], frames[1][:-1]], 20, [scenarios[1].id, "12 actions", "11 frames"]),
        (scenarios, [frames[0], frames[1] + frames[1]], 20, [scenarios[1].id, "more frames"]),
        (scenarios, frames[:1], 20, ["2 scenarios", "fewer episodes"]),
        (scenarios[:1], frames, 20, ["1 scenarios", "more episodes"]),
        ([empty], [[]], 20, ["empty", "0 frames", "at least one"]),
        (scenarios, frames, None, ["frame rate"]),
    ):
        with pytest.raises(ScenarioError) as caught:
            write_scenarios(tmp_path / "set", some, episodes=episodes, fps=fps)
        assert all(word in str(caught.value) for word in words), str(caught.value)
        assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_not_written_over(scenarios, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ScenarioError, match="not an empty folder"):
        write_episodes(tmp_path, scenarios, camera)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
