"""The way back to a recovery point: slow, along the recording, and stopped at once."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lerobot_roborecover.robot.approach import MotionConfig, StoppedError, move_to
from lerobot_roborecover.robot.connection import RobotError
from lerobot_roborecover.robot.points import point_of
from tests.support.robot_lab import lab
from tests.support.robot_points import made_point

pytestmark = pytest.mark.lerobot
CONFIG = MotionConfig(speed=100.0, max_detour=20.0, tolerance=3.0, max_lag=60.0)


def point(end, steps: int = 12):
    """A point whose approach goes straight to `end` from ten centimetres to its right."""
    path = np.linspace(np.add(end, (100.0, 0.0)), end, steps)
    joints = dict(zip(("x.pos", "y.pos"), path[-1].tolist(), strict=True))
    return replace(point_of(made_point("p")), joints=joints, approach=path, units={}, pictures={})


def sent_by(robot):
    """Collects what is sent to a robot."""
    found, send = [], robot.send_action

    def note(action):
        found.append(np.array([action["x.pos"], action["y.pos"]]))
        return send(action)

    robot.send_action = note
    return found


def go(robot, where, stopped=lambda: False, confirm=lambda text: False, config=CONFIG, given=None):
    return move_to(robot, where, config, stopped=stopped, confirm=confirm, given=given)


def test_it_follows_the_recording_in_small_steps(tmp_path):
    with lab(tmp_path) as robot:
        start = robot.world.positions()
        where = point(start - (100.0, 0.0))
        sent = sent_by(robot)
        error = go(robot, where)
    assert max(map(abs, error.values())) <= 3.0
    assert max(np.abs(b - a).max() for a, b in pairwise(sent)) <= 100.0 / 20.0 + 1e-6


def test_a_stop_leaves_the_arm_where_it_is(tmp_path):
    with lab(tmp_path) as robot:
        sent = sent_by(robot)
        with pytest.raises(StoppedError, match="stopped by a person"):
            go(robot, point(robot.world.positions() - (100.0, 0.0)), stopped=lambda: len(sent) >= 4)
    assert len(sent) == 4


def test_a_straight_way_to_the_approach_needs_a_yes(tmp_path):
    asked = []
    with lab(tmp_path) as robot:
        sent = sent_by(robot)
        far = point(np.add(robot.world.positions(), (0.0, 90.0)))
        with pytest.raises(StoppedError, match="was not confirmed"):
            go(robot, far, confirm=lambda text: bool(asked.append(text)))
        assert sent == []
        assert "off the recorded approach" in asked[0]
        assert max(map(abs, go(robot, far, confirm=lambda text: True).values())) <= 3.0


def test_a_blocked_joint_and_a_target_beyond_the_limits_stop_it(tmp_path):
    with lab(tmp_path) as robot:
        where = point(robot.world.positions() - (100.0, 0.0))
        robot.world.step = lambda target: None
        with pytest.raises(
            RobotError, match=r"joint x.pos is \d+ from its target, at most 10: it is blocked"
        ):
            go(robot, where, config=replace(CONFIG, max_lag=10.0))
    with lab(tmp_path) as robot:
        where, sent = point(robot.world.positions() - (100.0, 0.0)), sent_by(robot)
        with pytest.raises(RobotError, match="leaves the calibrated limits; the robot was not moved"):
            go(robot, where, given={"x.pos": (-1.0, 1.0)})
        assert sent == []
        # What noise has measured beyond the end of a joint's range is taken for the end.
        end = where.joints["x.pos"]
        assert max(map(abs, go(robot, where, given={"x.pos": (end + 0.5, 450.0)}).values())) <= 3.5
        assert min(target[0] for target in sent) == end + 0.5
