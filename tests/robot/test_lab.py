"""The simulated lab is an ordinary LeRobot robot, and behaves like one on a table."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.scenario import ScenarioError

pytestmark = pytest.mark.lerobot


def make(tmp_path, **options):
    from lerobot.robots import make_robot_from_config

    from lerobot_roborecover.robot.lab.config_lab_robot import LabRobotConfig

    robot = make_robot_from_config(
        LabRobotConfig(id="lab", calibration_dir=tmp_path, realtime=False, **options)
    )
    robot.connect()
    return robot


def drive(robot, target, steps):
    for _ in range(steps):
        robot.send_action(dict(zip(robot.action_features, target, strict=True)))
    return np.array([robot.get_observation()[n] for n in robot.action_features])


def test_lerobots_own_command_line_knows_the_lab(tmp_path):
    from draccus import decode
    from lerobot.robots import RobotConfig

    import lerobot_env_roborecover  # noqa: F401 - what LeRobot imports

    config = decode(RobotConfig, {"type": "roborecover_lab", "size": 48})
    assert (config.type, config.size) == ("roborecover_lab", 48)


def test_it_follows_targets_within_its_play_and_noise(tmp_path):
    robot = make(tmp_path, backlash=3.0, joint_noise=0.0)
    reached = drive(robot, (120.0, -80.0), 60)
    assert np.abs(reached - [120.0, -80.0]).max() <= 3.1
    other = drive(robot, (118.0, -80.0), 40)
    assert np.abs(other - reached).max() < 1.1  # within the play, next to nothing moves
    assert drive(robot, (0.0, 0.0), 60)[0] < 4.0


def test_a_limited_target_takes_small_steps(tmp_path):
    robot = make(tmp_path, max_relative_target=5.0, backlash=0.0, joint_noise=0.0)
    start = np.array([robot.get_observation()[n] for n in robot.action_features])
    sent = robot.send_action(dict(zip(robot.action_features, start + 200, strict=True)))
    assert np.abs(np.array(list(sent.values())) - start).max() == pytest.approx(5.0, abs=0.01)


def test_pictures_are_late_noisy_and_of_the_scene(tmp_path):
    robot = make(tmp_path, latency_steps=2, image_noise=0.0)
    first = robot.get_observation()["top"]
    robot.world.clear()
    seen = [robot.get_observation()["top"] for _ in range(3)]
    assert (seen[0] == first).all()
    assert (seen[1] == first).all()
    assert (seen[2] != first).any()
    noisy = make(tmp_path)
    _, one, other = (noisy.get_observation()["top"].astype(int) for _ in range(3))
    assert 1.0 < (one - other).std() < 5.0


def test_the_operator_puts_objects_back_with_errors_of_the_stated_size(tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    robot = make(tmp_path)
    truth = robot.hidden_truth()
    operator = SimulatedOperator(robot, seed=1, sd_mm=5.0)
    for _ in range(200):
        operator.clear()
        operator.place(truth)
    # The mean distance of a two-dimensional normal error is sd * sqrt(pi / 2).
    assert np.mean(operator.true_errors_mm) == pytest.approx(5.0 * np.sqrt(np.pi / 2), rel=0.15)
    with pytest.raises(ScenarioError, match="A person has to put them back"):
        operator.place({})


def test_it_breaks_when_it_is_told_to(tmp_path):
    from lerobot.utils.errors import DeviceNotConnectedError

    robot = make(tmp_path, unplug_at_step=3, freeze_at_step=2)
    drive(robot, (0.0, 0.0), 2)
    one, other = (robot.get_observation() for _ in range(2))
    assert (one["top"] == other["top"]).all()
    assert (one["wrist"] != other["wrist"]).any()
    drive_one_more = dict.fromkeys(robot.action_features, 0.0)
    robot.send_action(drive_one_more)
    with pytest.raises(DeviceNotConnectedError, match="does not answer"):
        robot.get_observation()
    assert not robot.is_connected


@pytest.mark.metaworld
@pytest.mark.render
def test_meta_world_as_a_lab(tmp_path):
    robot = make(tmp_path, world="metaworld", task="push-v3", size=64, joint_noise=0.0, backlash=0.0)
    reached = drive(robot, (50.0, 620.0, 180.0, 100.0), 25)
    assert np.abs(reached[:3] - [50.0, 620.0, 180.0]).max() < 6.0
    before = robot.get_observation()["front"].astype(int)
    truth = robot.hidden_truth()["objects"]
    robot.world.clear()
    assert robot.world.distance_m(truth) > 1.0
    robot.world.place(truth, np.array([0.02, 0.0]), 0.0)
    assert robot.world.distance_m(truth) == pytest.approx(0.02, abs=1e-6)
    assert before.shape == (64, 64, 3)
    assert robot.instruction
