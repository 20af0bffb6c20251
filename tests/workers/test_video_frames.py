"""Frames of a trial that is recorded: twenty a second, and the last one."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.workers.messages import EpisodeSpec, SlotConfig, video_stride
from lerobot_roborecover.workers.worker import SlotServer
from tests.support.factories import fake_scenario


@pytest.mark.parametrize(("hz", "stride"), [(10, 1), (20, 1), (25, 1), (50, 2), (80, 4)])
def test_a_video_has_about_twenty_frames_a_second(hz, stride):
    assert video_stride(hz) == stride


@pytest.mark.parametrize(("hz", "counts"), [(20.0, [3, 3, 4]), (80.0, [0, 1, 2])])
def test_frames_come_at_the_stride_across_chunks_and_at_the_end(monkeypatch, hz, counts):
    server = SlotServer(SlotConfig("fake"))
    monkeypatch.setattr(server._simulator, "control_hz", hz)
    scenario = fake_scenario(0, steps=4, horizon=10)
    start = server.answer("reset", EpisodeSpec(scenario, "recovery", 0, True, record_video=True))
    assert start.frame is not None
    found = [server.answer("act", np.zeros((n, 2))) for n in (3, 3, 9)]
    assert [len(r.frames) for r in found] == counts, "steps 4 and 8, and the tenth, which is the last"
    assert found[-1].over
