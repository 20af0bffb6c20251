"""`roborecover check-platform`: what a platform does wrong is a finding, never a traceback."""

from __future__ import annotations

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
