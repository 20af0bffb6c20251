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
