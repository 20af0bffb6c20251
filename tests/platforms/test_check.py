"""`roborecover check platform`: what a platform does wrong is a finding, never a traceback."""

from __future__ import annotations

from dataclasses import replace

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.check import CheckRequest, check_platform
from lerobot_roborecover.platforms.fake.simulator import FakeSimulator


def test_an_observation_that_cannot_be_made_is_named(monkeypatch):
    def broken(_self):
        raise KeyError("rgb")

    monkeypatch.setattr(FakeSimulator, "observe", broken)
    task = platform_named("fake").tasks()[0]
    checks = {check.name: check for check in check_platform(CheckRequest("fake", (task,), steps=4))}
    state = checks[f"{task.name}: state"]
    assert state.failed
    assert "observe() fails: KeyError: 'rgb'" in str(state)
    assert not checks[f"{task.name}: replay"].failed


def test_progress_that_is_none_or_disturbs_is_named(monkeypatch):
    """It says all is done where nothing is, and moves the puck when it is asked."""

    def disturbing(self):
        self._state = self._state + 1e-3
        return 1.0

    task = platform_named("fake").tasks()[0]
    good = {c.name: c for c in check_platform(CheckRequest("fake", (task,), steps=4))}
    assert not good[f"{task.name}: state"].failed
    monkeypatch.setattr(FakeSimulator, "progress", disturbing)
    checks = {c.name: c for c in check_platform(CheckRequest("fake", (task,), steps=4))}
    assert "progress() is 1.0 where succeeded() is False" in str(checks[f"{task.name}: state"])
    assert checks[f"{task.name}: pictures in between"].failed


def test_places_that_the_first_step_alone_puts_right_are_named(monkeypatch):
    """As Meta-World's own coffee machine: its button follows with the first step."""
    reset, bodies, restore = FakeSimulator.reset, FakeSimulator.bodies, FakeSimulator.restore
    late = []

    def late_bodies(simulator):
        places = bodies(simulator)
        name = next(n for n in places if not n.startswith("eef"))
        x, y, z = places[name].position_m
        return {**places, name: replace(places[name], position_m=(x + 0.06, y, z))} if late else places

    task = platform_named("fake").tasks()[0]
    name = f"{task.name}: first places"
    good = {c.name: c for c in check_platform(CheckRequest("fake", (task,), steps=4))}
    assert not good[name].failed
    monkeypatch.setattr(FakeSimulator, "reset", lambda sim, *of: (late.append(1), reset(sim, *of))[1])
    monkeypatch.setattr(FakeSimulator, "bodies", late_bodies)
    monkeypatch.setattr(FakeSimulator, "restore", lambda sim, kept: (late.clear(), restore(sim, kept))[1])
    found = {c.name: c for c in check_platform(CheckRequest("fake", (task,), steps=4))}[name]
    assert found.failed
    assert "60 mm from where the same state has it once it is restored" in str(found)
