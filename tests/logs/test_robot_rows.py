"""Rows of robots' trials: read, merged and reported like any other, and earlier logs are read as before."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from lerobot_roborecover.logs.robot import CameraError, RobotTrial, StartError
from lerobot_roborecover.logs.trial_log import TrialLogError, read_trial_log
from tests.support.trial_rows import trial_row, write_log

ERROR = StartError({"pan.pos": -0.4}, {"top": CameraError(0.5, 2.0, 0.93), "wrist": CameraError(tag_mm=3.0)})
TRIAL = RobotTrial(
    "so101_follower", "ab" * 32, "failure", "kim", "A", ERROR, 41.5, 2, 12.0, 1, 7, 4, "slipped"
)


def robot_row(scenario: int = 1, trial: int = 0, success: bool = False, robot: RobotTrial = TRIAL, **changes):
    """One row of a robot; failures ended before the time was up."""
    values = {"platform": "robot", "suite": "so101_follower", "steps": 120, "robot": robot.as_json()}
    return trial_row(scenario, trial, success, **(values | changes))


def test_a_robots_trial_comes_back_as_it_was(tmp_path):
    row = robot_row()
    (found,) = read_trial_log(write_log(tmp_path / "trials.jsonl", [row]))
    assert found == row
    assert RobotTrial.of_json(found.robot) == TRIAL
    assert ERROR.worst("object_px") == 2.0
    assert ERROR.worst("similarity") == 0.93
    assert ERROR.worst("joint") == 0.4
    assert StartError().worst("tag_mm") is None


def test_a_camera_on_the_arm_says_nothing_of_the_scene(tmp_path):
    on_arm = CameraError(object_px=9.0, similarity=0.1, moving=True)
    error = StartError({}, {"top": CameraError(0.5, 2.0, 0.93), "wrist": on_arm})
    assert (error.worst("object_px"), error.worst("similarity")) == (2.0, 0.93)
    assert StartError({}, {"wrist": on_arm}).worst("object_px") is None
    row = robot_row(robot=replace(TRIAL, start_error=error))
    log = write_log(tmp_path / "trials.jsonl", [row])
    (found,) = read_trial_log(log)
    assert RobotTrial.of_json(found.robot).start_error == error
    # Rows of earlier versions do not say which cameras are on the arm.
    log.write_text(log.read_text().replace(', "moving": false', "").replace(', "moving": true', ""))
    assert "moving" not in log.read_text()
    (found,) = read_trial_log(log)
    assert RobotTrial.of_json(found.robot).start_error.worst("object_px") == 9.0


def test_a_failed_simulated_trial_still_takes_its_whole_horizon(tmp_path):
    log = write_log(tmp_path / "trials.jsonl", [robot_row(robot=TRIAL)])
    record = {**json.loads(log.read_text()), "robot": None}
    log.write_text(json.dumps(record) + "\n")
    with pytest.raises(TrialLogError, match="steps is 120, but the outcome is 'horizon'"):
        read_trial_log(log)


def test_a_row_of_schema_3_says_nothing_of_robots(tmp_path):
    record = {**asdict(trial_row(1)), "schema": 3}
    del record["robot"]
    path = tmp_path / "trials.jsonl"
    path.write_text(json.dumps(record) + "\n")
    assert read_trial_log(path)[0].robot is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"verdict": "maybe"}, "verdict is not one of success, failure, invalid"),
        ({"note": 3}, "note is not text"),
        ({"episode": -1}, "episode is neither null nor a number"),
        ({"reset_s": float("nan")}, "reset_s is neither null nor seconds"),
        ({"start_error": {"joints": {}}}, "start_error is not an object with joints"),
        ({"start_error": {"joints": {}, "cameras": {"top": {}}, "problems": []}}, "cameras' measures"),
        ({"colour": 1}, "field 'colour' is missing or not known"),
    ],
)
def test_a_damaged_field_is_refused_by_line(tmp_path, change, words):
    log = write_log(tmp_path / "trials.jsonl", [robot_row()])
    record = json.loads(log.read_text())
    record["robot"].update(change)
    log.write_text(json.dumps(record) + "\n")
    with pytest.raises(TrialLogError, match=f"line 1: field 'robot': .*{words}"):
        read_trial_log(log)
