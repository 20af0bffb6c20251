"""Replaying a converted release: exact resets, fingerprints and episodes, in parallel and resumable."""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import pytest

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.fingerprint import fingerprint_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.render import check_rendering, render_dataset
from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import Reset, ScenarioError, Task
from lerobot_roborecover.workers.jobs import JobPool, simulator_of_worker
from tests.support.conversion_scripts import script
from tests.support.factories import fake_scenario
from tests.support.release_files import libero_record, write_release

convert = script("roborecover_release").main


def bare(index: int):
    """A fake scenario without its fingerprint."""
    scenario = fake_scenario(index)
    object.__setattr__(scenario, "fingerprint", None)
    return scenario


def refuse_odd_seeds(simulator, scenario):
    if scenario.reset.seed % 2:
        raise ScenarioError(f"seed {scenario.reset.seed} is odd")
    return {"off_mm": float(scenario.reset.seed)}


@pytest.mark.slow
def test_fingerprints_are_those_of_a_replay_whatever_the_workers(tmp_path):
    scenarios = [bare(i) for i in range(12)]
    expected = [fake_scenario(i).fingerprint for i in range(12)]
    for workers in (1, 3):
        found = fingerprint_scenarios(scenarios, tmp_path / f"{workers}.jsonl", workers=workers)
        assert [r.scenario.fingerprint for r in found] == expected
        assert not any(r.error for r in found)


def test_a_failure_is_one_result_and_the_rest_goes_on(tmp_path):
    found = fingerprint_scenarios([bare(i) for i in range(4)], tmp_path / "log", check=refuse_odd_seeds)
    assert [r.error for r in found] == ["", "seed 1 is odd", "", "seed 3 is odd"]
    assert [dict(r.deviations) for r in found] == [{"off_mm": 0.0}, {}, {"off_mm": 2.0}, {}]


def fail_like_a_simulator(simulator, scenario):
    if scenario.reset.seed == 1:
        raise IndexError("contact buffer")
    return {}


@pytest.mark.nightly
def test_an_unforeseen_error_of_a_simulator_is_one_result_too(tmp_path):
    found = fingerprint_scenarios([bare(i) for i in range(3)], tmp_path / "log", check=fail_like_a_simulator)
    assert [r.error for r in found] == ["", "IndexError: contact buffer", ""]


@pytest.mark.slow
def test_a_stopped_run_goes_on_and_repeats_only_what_failed(tmp_path):
    scenarios, log = [bare(i) for i in range(6)], tmp_path / "log"
    fingerprint_scenarios(scenarios[:4], log, check=refuse_odd_seeds)
    lines = log.read_bytes().splitlines(keepends=True)
    assert len(lines) == 2
    log.write_bytes(lines[0] + lines[1][:-20])
    counts = []
    found = fingerprint_scenarios(scenarios, log, progress=lambda done, total: counts.append((done, total)))
    assert counts[0] == (1, 6)
    assert counts[-1] == (6, 6)
    assert [r.scenario.fingerprint for r in found] == [fake_scenario(i).fingerprint for i in range(6)]
    assert len(log.read_bytes().splitlines()) == 6


def test_a_log_damaged_inside_is_refused(tmp_path):
    (tmp_path / "log").write_bytes(b"{}\n{}\n")
    with pytest.raises(ScenarioError, match="line 1 is damaged"):
        fingerprint_scenarios([bare(0)], tmp_path / "log")


def test_a_simulator_that_cannot_be_made_is_one_refusal(tmp_path):
    with pytest.raises(SimulatorError, match="obs_type"):
        fingerprint_scenarios([bare(0)], tmp_path / "log", options={"obs_type": "smell"})


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_rendered_shards_become_one_dataset_and_a_rerun_uses_them(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_roborecover.datasets.episodes import SCENARIO_INDEX

    scenarios = [fake_scenario(i, steps=4 + i % 3) for i in range(12)]
    options = {"obs_type": "pixels_agent_pos", "observation_size": 64}
    counts = []
    with JobPool("fake", options, 2) as pool:
        render_dataset(tmp_path / "one", scenarios, tmp_path / "work", pool=pool)
        render_dataset(
            tmp_path / "two", scenarios, tmp_path / "work", pool=pool,
            progress=lambda done, total: counts.append((done, total)),
        )  # fmt: skip
    assert counts == [(2, 2)]
    for name in ("one", "two"):
        dataset = LeRobotDataset("lab/set", root=tmp_path / name)
        assert dataset.num_episodes == 12
        assert dataset.num_frames == sum(len(s.prefix) for s in scenarios)
        rows = dataset.hf_dataset.with_format("arrow")[SCENARIO_INDEX].to_pylist()
        assert rows == [i for i, s in enumerate(scenarios) for _ in s.prefix]
        assert dataset[len(dataset) - 1]["observation.image"].shape == (3, 64, 64)
        assert [s.sha256() for s in load_scenarios(tmp_path / name)] == [s.sha256() for s in scenarios]
        assert list(FrameStore(tmp_path / name)) == [s.id for s in scenarios]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def process_and_simulator():
    return os.getpid(), id(simulator_of_worker())


@pytest.mark.slow
def test_one_process_and_one_simulator_serve_every_step(tmp_path):
    """Each would compile the task anew: six seconds of CPU on LIBERO, three times a conversion."""
    scenarios = [bare(i) for i in range(3)]
    with JobPool("fake", {"obs_type": "pixels_agent_pos", "observation_size": 32}) as pool:
        (first,) = pool.run(process_and_simulator, [0], lambda _: ())
        check_rendering(scenarios, pool)
        found = fingerprint_scenarios(scenarios, tmp_path / "log", pool=pool)
        assert [r.scenario.fingerprint for r in found] == [fake_scenario(i).fingerprint for i in range(3)]
        done = [r.scenario for r in found]
        render_dataset(tmp_path / "set", done, tmp_path / "work", pool=pool, episodes=False)
        (last,) = pool.run(process_and_simulator, [0], lambda _: ())
        assert first == last
        # The last frames alone need no LeRobot, which takes longer to import than they to be drawn.
        assert not pool.call(has_imported, "lerobot")
    assert not (tmp_path / "set/meta/info.json").exists()
    store = FrameStore(tmp_path / "set")
    assert [len(next(iter(store.of(s).png.values()))) for s in load_scenarios(tmp_path / "set")] == [5, 5, 5]


def has_imported(name):
    return name in sys.modules


@pytest.mark.slow
def test_a_process_that_dies_is_a_refusal_that_says_what_to_do():
    with JobPool("fake") as pool, pytest.raises(SimulatorError, match="worker process died"):
        list(pool.run(os._exit, [3]))
    with JobPool("fake") as pool, pytest.raises(SimulatorError, match="worker process died"):
        pool.call(os._exit, 3)


@pytest.fixture(scope="module")
def true_state():
    """What the release records of LIBERO's first state: here from the simulator itself."""
    simulator = make_simulator("libero", obs_type="state")
    name = "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
    try:
        simulator.reset(Task("libero", "libero_spatial", name, "go", 220), Reset(seed=7, init_state_index=0))
        robot = simulator.observe()["robot_state"]
    finally:
        simulator.close()
    return {
        "gripper": float(robot["gripper"]["qpos"][0]),
        "quat": robot["eef"]["quat"].tolist(),
        "rpy": [0.0, 0.0, 0.0],
        "xyz": robot["eef"]["pos"].tolist(),
    }


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_libero_records_get_fixtures_and_fingerprint_and_a_wrong_state_is_reported(
    tmp_path, true_state, capsys
):
    good, bad = libero_record(0, 6), libero_record(0, 8)
    good["initial_state"] = true_state
    bad["initial_state"] = {**true_state, "xyz": [true_state["xyz"][0] + 0.013, *true_state["xyz"][1:]]}
    release = write_release(tmp_path / "release", {"libero": {"test": [good, bad]}})
    arguments = [str(release), "--out", str(tmp_path / "out"), "--fingerprint", "--workers", "1"]
    assert convert(arguments) == 1
    said = capsys.readouterr().err
    assert "libero/test/libero_test_0001.json" in said
    assert "position_mm is off by 13" in said
    (scenario,) = load_scenarios(tmp_path / "out" / "libero")
    assert scenario.id == "libero_test_0000"
    assert scenario.reset.fixtures
    assert scenario.fingerprint.step == 16
    report = json.loads((tmp_path / "out" / "libero" / "meta/roborecover/conversion.json").read_text())
    assert report["initial_state_largest_deviation"]["position_mm"] < 1e-4
    simulator = make_simulator("libero", obs_type="state")
    try:
        handoff = hand_off(simulator, scenario)
    finally:
        simulator.close()
    assert (handoff.problem, handoff.identical, handoff.eef_error_mm) == (None, True, 0.0)


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.lerobot
@pytest.mark.render
@pytest.mark.slow
def test_libero_render_gives_a_training_ready_dataset(tmp_path, true_state):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    record = libero_record(0, 2)
    record["initial_state"] = true_state
    release = write_release(tmp_path / "release", {"libero": {"test": [record]}})
    arguments = [str(release), "--out", str(tmp_path / "out"), "--render", "--size", "64", "--workers", "1"]
    assert convert(arguments) == 0
    assert os.listdir(tmp_path / "out") == ["libero"]
    dataset = LeRobotDataset("lab/set", root=tmp_path / "out" / "libero")
    assert dataset.num_frames == 12
    item = dataset[0]
    assert item["observation.images.image"].shape == (3, 64, 64)
    np.testing.assert_allclose(item["observation.state"][:3], true_state["xyz"], atol=1e-6)
    (scenario,) = load_scenarios(tmp_path / "out" / "libero")
    assert scenario.fingerprint is not None
    kept = FrameStore(tmp_path / "out" / "libero").of(scenario).arrays()
    assert {key: value.shape for key, value in kept.items()} == {
        "observation.images.image": (5, 64, 64, 3),
        "observation.images.image2": (5, 64, 64, 3),
    }
    # The video is lossy; upside down, or of another step, it would differ by far more.
    video = dataset[11]["observation.images.image"].numpy().transpose(1, 2, 0) * 255
    assert np.abs(video - kept["observation.images.image"][-2]).mean() < 6
