"""What goes wrong while a plan is run: one clear line each, and nothing that was done is lost."""

from __future__ import annotations

import json
import shutil

import pytest

from lerobot_roborecover.logs.robot import RobotTrial
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.robot.connection import RobotError
from tests.robot.test_run import Spoken, go
from tests.support.robot_lab import lab

pytestmark = pytest.mark.lerobot


def test_a_clock_that_jumps_is_in_the_row_and_changes_no_duration(made, tmp_path, monkeypatch):
    import time

    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    real, jump = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + jump[0])

    class Jumps(Spoken):
        def answer(self, screen, details):
            jump[0] = 3600.0 if screen == "running" else jump[0]
            return super().answer(screen, details)

    with lab(made) as robot:
        operator = SimulatedOperator(robot, sd_mm=0.0)
        rows, _ = go(made, tmp_path, robot, Jumps(operator), stop_after=1)
    trial = RobotTrial.of_json(rows[0].robot)
    assert trial.clock_jump_s == pytest.approx(3600, abs=2)
    assert trial.duration_s < 7


def test_a_start_outside_the_tolerance_is_not_run(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    with lab(made) as robot:
        careless = SimulatedOperator(robot, sd_mm=0.0, bias_mm=(60.0, 0.0), max_tries=2)
        rows, lines = go(made, tmp_path, robot, careless, stop_after=1)
        robot.world.bump("top", (6.0, 0.0))
        careful = SimulatedOperator(robot, sd_mm=0.0, max_tries=1)
        bumped, _ = go(made, tmp_path / "bumped", robot, careful, stop_after=1)
    assert rows[0].outcome == "state_mismatch"
    assert "objects are" in rows[0].reason
    assert "not run" in lines[0]
    assert RobotTrial.of_json(rows[0].robot).attempts >= 2
    assert "the camera has moved by" in bumped[0].reason


def test_a_robot_unplugged_in_mid_trial_leaves_a_row_and_the_run_goes_on_later(made, tmp_path):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    with lab(made, unplug_at_step=90) as robot:
        operator = SimulatedOperator(robot, sd_mm=0.0)
        with pytest.raises(RobotError, match="does not answer"):
            go(made, tmp_path, robot, Spoken(operator, running=[]), repeats=20)
    before = read_trial_log(tmp_path / "trials.jsonl") if (tmp_path / "trials.jsonl").is_file() else []
    with lab(made) as robot:
        rows, _ = go(made, tmp_path, robot, SimulatedOperator(robot, sd_mm=0.0), repeats=20, stop_after=1)
    assert len(rows) == len(before) + 1


def test_points_of_another_robot_calibration_or_reach_are_refused(made, tmp_path):
    from dataclasses import replace

    from lerobot_roborecover.robot.connection import check_point
    from lerobot_roborecover.robot.points import read_points

    point = read_points(made / "points").points[0]
    with lab(made) as robot:
        check_point(point, robot)
        for change, words in (
            ({"robot_type": "so101_follower"}, "is of robot 'so101_follower', this one is 'roborecover_lab'"),
            ({"calibration_sha256": "ab" * 32}, "was recorded with calibration abababababab"),
            ({"quasi_static": False}, "is not quasi-static"),
            ({"pictures": {"side": "x"}}, "was seen by camera 'side'"),
        ):
            with pytest.raises(RobotError, match=words):
                check_point(replace(point, **change), robot)
        with pytest.raises(RobotError, match=r"outside its calibrated -1.0 to 1.0"):
            check_point(point, robot, {"y.pos": (-1.0, 1.0)})


def test_a_full_disk_stops_before_a_trial(made, tmp_path, monkeypatch):
    from lerobot_roborecover.robot.lab.operator import SimulatedOperator

    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(2**30, 2**30, 0))
    with lab(made) as robot, pytest.raises(RobotError, match="Make room, then start the same command again"):
        go(made, tmp_path, robot, SimulatedOperator(robot))
    assert json.loads((tmp_path / "plan.lock.json").read_text())["sha256"]
