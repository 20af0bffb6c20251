"""Time, keys and devices of teleoperation."""

from __future__ import annotations

import queue
import struct
import time

import numpy as np
import pytest

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.controls import AXES
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.teleop.pilot import HOLD_S, MAX_WAITING, InputHandler, OperatorCommand, Tick
from lerobot_roborecover.web.teleop.spacemouse import Reports, SpaceMouse
from lerobot_roborecover.web.teleop.starts import first_states
from tests.support.processes import PATIENCE_S


class Clock:
    """Time that passes only during waits, whatever this machine is busy with."""

    def __init__(self):
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds + 1e-9

    def pilot(self, rate_hz: float = 50.0) -> InputHandler:
        """One whose line waits by this clock."""
        clock = self

        class Line(queue.Queue):
            def get(self, block: bool = True, timeout: float | None = None):
                if block and self.empty():
                    clock.sleep(timeout)
                return super().get(block=False)

        return InputHandler(rate_hz, 50.0, _queue=Line(MAX_WAITING))

    def ticks(self, pilot: InputHandler, seconds: float) -> list[Tick]:
        deadline, found = self.now_s + seconds, []
        while (left := deadline - self.now_s) > 0:
            event = pilot.poll(left)
            if isinstance(event, Tick):
                found.append(event)
        return found


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr("lerobot_roborecover.web.teleop.pilot.time", made)
    return made


ONE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NONE = (0.0,) * 6


def test_time_passes_only_while_something_is_held(clock):
    pilot = clock.pilot()
    assert clock.ticks(pilot, 0.1) == []
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    assert [t.axes for t in clock.ticks(pilot, 0.1)] == [ONE], "a tap is one step"
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    clock.sleep(HOLD_S + 0.1)
    assert [t.axes for t in clock.ticks(pilot, 0.1)] == [ONE], "also where the simulator was busy meanwhile"
    pilot.hold("keyboard", ONE)
    held = clock.ticks(pilot, 1.2)
    assert len(held) in (30, 31), "it is released after 0.6 seconds"
    pilot.hold("keyboard", NONE, wait=True)
    assert {t.axes for t in clock.ticks(pilot, 0.1)} == {NONE}
    pilot.let_go()
    pilot.toggle_gripper()
    assert len(moved := clock.ticks(pilot, 1.0)) == 25, "half a second for the gripper"
    assert all(t.closed for t in moved)
    pilot.hold("keyboard", ONE)
    pilot.hold("gamepad", (0.5, -0.5, 0, 0, 0, 0))
    assert clock.ticks(pilot, 0.1)[-1].axes == (1.0, -0.5, 0, 0, 0, 0)


def test_what_is_pressed_before_the_start_moves_nothing_later(clock):
    pilot = clock.pilot()
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    assert pilot.poll(0.05, drive=False) is None
    pilot.hold("keyboard", ONE)
    pilot.hold("keyboard", NONE)
    assert [t.axes for t in clock.ticks(pilot, 0.1)] == [ONE]


def test_a_pause_postpones_steps_and_keeps_taps(clock):
    pilot = clock.pilot()
    pilot.hold("keyboard", ONE)
    assert pilot.poll(0.1, paused=True) is None
    pilot.hold("keyboard", NONE)
    assert pilot.poll(0.1, paused=True).axes == ONE, "a tap that ends meanwhile"
    assert pilot.poll(0.05) is None


def test_steps_lost_to_a_picture_are_made_up_for_up_to_a_limit(clock):
    pilot = clock.pilot()
    pilot.realtime = True
    pilot.poll(0.1)
    clock.sleep(0.5)
    caught_up = 0
    while isinstance(pilot.poll(0.0), Tick):
        caught_up += 1
    assert caught_up in (12, 13), "a quarter of a second at 50 steps a second"


def test_a_full_line_of_commands_refuses_more():
    pilot, answers = InputHandler(1.0, 1.0), []
    for _ in range(300):
        pilot.command(OperatorCommand("status", {}, answers.append))
    assert len(answers) == 44
    assert "does not keep up" in answers[0]["message"]


@pytest.mark.parametrize("platform", ["fake", "metaworld", "libero"])
def test_every_axis_has_a_column_of_its_own_within_the_platforms_bounds(platform):
    controls = platform_named(platform).controls()
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
        platform_named("robotwin").controls()
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


@pytest.mark.slow
def test_a_spacemouse_drives_and_may_be_unplugged(tmp_path):
    away = report(1, 0, -350, 0, 0, 0, 0)
    mice = [Mouse([away, [3, 1, 0], [3, 0, 0]], unplugged=True), Mouse([away, report(1, 0, 0, 0, 0, 0, 0)])]
    pilot, opened = InputHandler(50.0, 50.0), iter(mice)
    mouse = SpaceMouse(pilot, 0.5, lambda: next(opened))
    mouse.start()
    event = pilot.poll(PATIENCE_S)
    assert isinstance(event, Tick)
    assert (event.axes[0], event.device) == (0.5, "spacemouse")
    while not isinstance(event, OperatorCommand):
        event = pilot.poll(PATIENCE_S)
    assert event.kind == "gripper"
    event.reply({"ok": True})
    deadline = time.monotonic() + PATIENCE_S
    while not mice[0].closed and time.monotonic() < deadline:
        pilot.poll(0.05)
    assert mice[0].closed, "one that was unplugged is let go"
    while mice[1].reports and time.monotonic() < deadline:
        pilot.poll(0.1)
    mouse.stop()
    assert mice[1].closed
    assert not mice[1].reports, "it is found again"
