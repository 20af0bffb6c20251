"""Replaying converted RoboTwin records: on the stand-in, or with ROBOTWIN_ROOT on RoboTwin's own code."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.scenario import Reset, Task
from tests.support.conversion_scripts import script
from tests.support.release_files import robotwin_record, write_release
from tests.support.robotwin_checkouts import REAL, ROOT

pytestmark = pytest.mark.robotwin

convert = script("roborecover_release").main
STEPS = 5
UNSTABLE_SEED = 13
"""Of the stand-in: a plank on its edge falls over."""


@pytest.fixture(scope="module")
def simulator():
    made = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    yield made
    made.close()


def record(simulator, seed: int, **changes) -> dict:
    """A record as the release has it: what RoboTwin reports after its reset, and actions."""
    made = {**robotwin_record(0, STEPS), "seed": seed, **changes}
    task = Task("robotwin", made["task_config"], made["task_name"], made["instruction"], 800)
    simulator.reset(task, Reset(seed=seed))
    joints, ends = simulator.robotwin_task.joint_state(), simulator.robotwin_task.end_effectors()
    actions = joints + np.cumsum(np.full((STEPS, 14), 0.013), axis=0)
    actions[:, [6, 13]] = np.linspace(1, 0.3, STEPS)[:, None]
    made["initial_state"] = {
        "joint_vector": joints.tolist(),
        "left_endpose": ends[:7].tolist(),
        "right_endpose": ends[8:15].tolist(),
        "left_gripper": ends[7],
        "right_gripper": ends[15],
    }
    return {**made, "actions": actions.tolist()}


def test_records_are_replayed_fingerprinted_and_every_mismatch_has_its_size(
    simulator, tmp_path, capsys, monkeypatch
):
    good, off = record(simulator, 3), record(simulator, 4)
    said = off["initial_state"]
    said["joint_vector"][2] += 0.05
    said["right_endpose"][0] -= 0.013
    said["left_endpose"][3:] = np.negative(said["left_endpose"][3:]).tolist()  # the same rotation
    said["left_gripper"] = 0.5
    ee = {**robotwin_record(2, ee=True), "initial_state": good["initial_state"], "seed": 3}
    records = [good, off, ee, *([] if REAL else [{**good, "seed": UNSTABLE_SEED}])]
    release = write_release(tmp_path / "release", {"robotwin": {"test": records}})
    monkeypatch.setenv("ROBOTWIN_ROOT", ROOT)
    assert convert([str(release), "--out", str(tmp_path / "out"), "--fingerprint", "--workers", "1"]) == 1
    printed = capsys.readouterr()
    assert f"1 scenarios converted, {len(records) - 1} refused; fingerprinted" in printed.out
    assert (
        "robotwin/test/robotwin_test_0001.json: field initial_state: joint_rad is off by 0.05 (limit 0.02), "
        "left_gripper is off by 0.5 (limit 0.02), right_position_mm is off by 13 (limit 2)" in printed.err
    )
    assert "robotwin_test_0002.json: end-effector actions (width 16) are planned by curobo" in printed.err
    (scenario,) = load_scenarios(tmp_path / "out" / "robotwin")
    report = json.loads((tmp_path / "out/robotwin/meta/roborecover/conversion.json").read_text())
    worst = report["initial_state_largest_deviation"]
    assert worst["joint_rad"] == worst["left_gripper"] == worst["right_position_mm"] == 0
    assert worst["left_rotation_rad"] < 1e-6
    assert [r["sample_id"][-1] for r in report["refused"]] == ["1", "2", "3"][: len(records) - 1]
    if not REAL:
        assert f"robotwin_test_0003.json: RoboTwin task stack_blocks_two, seed {UNSTABLE_SEED}" in printed.err
    assert {"eef_left", "eef_right"} < set(scenario.fingerprint.bodies)
    assert scenario.fingerprint.step == STEPS
    handoff = hand_off(simulator, scenario)
    assert (handoff.problem, handoff.identical, handoff.object_error_mm) == (None, True, 0.0)


def test_without_a_checkout_nothing_is_written_not_even_for_libero(tmp_path, capsys, monkeypatch):
    from tests.support.release_files import libero_record

    monkeypatch.delenv("ROBOTWIN_ROOT", raising=False)
    records = {"libero": {"test": [libero_record(0)]}, "robotwin": {"test": [robotwin_record(0)]}}
    release = write_release(tmp_path / "release", records)
    assert convert([str(release), "--out", str(tmp_path / "out"), "--render"]) == 2
    assert "no RoboTwin checkout is named" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_vulkan")
def test_a_machine_that_cannot_render_says_so_before_anything_is_replayed(simulator, tmp_path, capsys):
    release = write_release(tmp_path / "release", {"robotwin": {"test": [record(simulator, 3)]}})
    arguments = [str(release), "--out", str(tmp_path / "out"), "--render", "--workers", "1"]
    assert convert([*arguments, "--robotwin-root", ROOT, "--render-quality", "trivial"]) == 2
    assert "SAPIEN found no Vulkan device" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.nightly
@pytest.mark.render
@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_rendered_records_are_a_lerobot_dataset_with_robotwin_s_cameras(simulator, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    good = record(simulator, 3)
    release = write_release(tmp_path / "release", {"robotwin": {"test": [good]}})
    arguments = [str(release), "--out", str(tmp_path / "out"), "--render", "--workers", "1"]
    assert convert([*arguments, "--robotwin-root", ROOT, "--render-quality", "trivial"]) == 0
    dataset = LeRobotDataset("lab/set", root=tmp_path / "out" / "robotwin")
    assert dataset.num_frames == STEPS
    assert dataset[0]["observation.images.head_camera"].shape == (3, 240, 320)
    np.testing.assert_allclose(
        dataset[0]["observation.state"], good["initial_state"]["joint_vector"], atol=1e-6
    )
