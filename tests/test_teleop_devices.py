"""Time, keys and devices of teleoperation."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest

from lerobot_roborecover.build.teleop.controls import AXES, controls_of
from lerobot_roborecover.build.teleop.pilot import HOLD_S, Command, Pilot, Tick
from lerobot_roborecover.build.teleop.spacemouse import Reports, SpaceMouse
from lerobot_roborecover.build.teleop.starts import first_states
from lerobot_roborecover.scenario import ScenarioError


def ticks(pilot: Pilot, seconds: float) -> list[Tick]:
    deadline, found = time.monotonic() + seconds, []
    while (left := deadline - time.monotonic()) > 0:
        event = pilot.poll(left)
        if isinstance(event, Tick):
            found.append(event)
    return found


ONE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NONE = (0.0,) * 6


def test_time_passes_only_while_something_is_held():
    pilot = Pilot(50.0, 50.0)
    assert ticks(pilot, 0.1) == []
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    assert [t.axes for t in ticks(pilot, 0.1)] == [ONE], "a tap is one step"
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    time.sleep(HOLD_S + 0.1)
    assert [t.axes for t in ticks(pilot, 0.1)] == [ONE], "also where the simulator was busy meanwhile"
    pilot.hold("keyboard", ONE)
    held = ticks(pilot, 1.2)
    assert 10 <= len(held) <= 33, "nobody holds it any more after 0.6 seconds"
    pilot.hold("keyboard", NONE, wait=True)
    assert {t.axes for t in ticks(pilot, 0.1)} == {NONE}
    pilot.let_go()
    pilot.toggle_gripper()
    assert len(moved := ticks(pilot, 1.0)) == 25, "half a second for the gripper"
    assert all(t.closed for t in moved)
    pilot.hold("keyboard", ONE)
    pilot.hold("gamepad", (0.5, -0.5, 0, 0, 0, 0))
    assert ticks(pilot, 0.1)[-1].axes == (1.0, -0.5, 0, 0, 0, 0)


def test_steps_lost_to_a_picture_are_made_up_for_up_to_a_limit():
    pilot = Pilot(50.0, 50.0)
    pilot.realtime = True
    pilot.poll(0.1)
    time.sleep(0.5)
    caught_up = 0
    while isinstance(pilot.poll(0.0), Tick):
        caught_up += 1
    assert 11 <= caught_up <= 15, "a quarter of a second at 50 steps a second"


def test_a_full_line_of_commands_refuses_more():
    pilot, answers = Pilot(1.0, 1.0), []
    for _ in range(300):
        pilot.command(Command("status", {}, answers.append))
    assert len(answers) == 44
    assert "does not keep up" in answers[0]["message"]


@pytest.mark.parametrize("platform", ["fake", "metaworld", "libero"])
def test_every_axis_has_a_column_of_its_own_within_the_platforms_bounds(platform):
    controls = controls_of(platform)
    columns = [c for c, _ in controls.columns.values()] + ([controls.gripper[0]] if controls.gripper else [])
    assert sorted(columns) == list(range(controls.width))
    for i, name in enumerate(AXES):
        axes = np.zeros(6)
        axes[i] = -1.0
        moved = controls.action(axes, closed=True)
        assert controls.check(moved) is not None
        changed = np.flatnonzero(moved != controls.action(NONE, closed=True)).tolist()
        assert changed == ([controls.columns[name][0]] if name in controls.columns else [])
    assert controls.closed_by(controls.action(NONE, True)) == (controls.gripper is not None)
    assert not controls.closed_by(controls.action(NONE, False))


def test_what_cannot_be_driven_says_why():
    with pytest.raises(ScenarioError, match="14 absolute joint targets"):
        controls_of("robotwin")
    with pytest.raises(ScenarioError, match="--seeds '3-x'"):
        first_states("fake", ["push-left"], "", "3-x", None)
    with pytest.raises(ScenarioError, match="more than 100000"):
        first_states("fake", ["push-left"], "", "0-4000000000", None)
    with pytest.raises(ScenarioError, match="beyond 2"):
        first_states("fake", ["push-left"], "", "0-99999999999999999999", None)
    with pytest.raises(ScenarioError, match="no init states"):
        first_states("fake", ["push-left"], "", None, "0")
    assert [s.reset.seed for s in first_states("fake", ["push-left"], "", "2-3,9", None)] == [2, 3, 9]


def report(kind: int, *values: int) -> list[int]:
    return list(bytes([kind]) + struct.pack(f"<{len(values)}h", *values))


def test_spacemouse_reports_become_axes():
    reports = Reports()
    reports.take(report(1, 0, -350, 0))
    assert reports.axes(0.5) == [0.5, 0, 0, 0, 0, 0], "pushed away from the user: forward"
    reports.take(report(1, 700, 0, -182))
    assert reports.axes(1.0)[:3] == pytest.approx([0, -1, (0.52 - 0.05) / 0.95]), "right, and lifted"
    reports.take(report(2, 0, 0, 350))
    assert reports.axes(1.0)[3:] == [0, 0, -1], "turned clockwise seen from above"
    reports.take(report(1, 10, -10, 5, 350, 0, 0))
    assert reports.axes(1.0) == [0, 0, 0, 0, -1, 0], "one report for all; a touch is nothing"
    before = list(reports.raw)
    for damaged in ([], [1], [1, 2, 3], [9, 1, 1, 1, 1, 1, 1], [2, 0, 0, 0]):
        assert reports.take(damaged) == []
    assert reports.raw == before
    assert reports.take([3, 0b01, 0]) == [0]
    assert reports.take([3, 0b11, 0]) == [1]
    assert reports.take([3, 0b00, 0]) == []


class Mouse:
    """Gives reports one after another, then stays still; or is unplugged."""

    def __init__(self, reports, unplugged=False):
        self.reports, self.unplugged, self.closed = list(reports), unplugged, False

    def read(self, size, timeout_ms):
        if self.reports:
            return self.reports.pop(0)
        if self.unplugged:
            raise OSError("read error")
        time.sleep(timeout_ms / 1000)
        return []

    def close(self):
        self.closed = True


def test_a_spacemouse_drives_and_may_be_unplugged(tmp_path):
    away = report(1, 0, -350, 0, 0, 0, 0)
    mice = [Mouse([away, [3, 1, 0], [3, 0, 0]], unplugged=True), Mouse([away, report(1, 0, 0, 0, 0, 0, 0)])]
    pilot, opened = Pilot(50.0, 50.0), iter(mice)
    mouse = SpaceMouse(pilot, 0.5, lambda: next(opened))
    mouse.start()
    event = pilot.poll(2.0)
    assert isinstance(event, Tick)
    assert (event.axes[0], event.device) == (0.5, "spacemouse")
    while not isinstance(event, Command):
        event = pilot.poll(2.0)
    assert event.kind == "gripper"
    event.reply({"ok": True})
    assert mice[0].closed or ticks(pilot, 0.5) is not None
    deadline = time.monotonic() + 5
    while mice[1].reports and time.monotonic() < deadline:
        pilot.poll(0.1)
    mouse.stop()
    assert mice[0].closed
    assert mice[1].closed
    assert not mice[1].reports, "it is found again"
