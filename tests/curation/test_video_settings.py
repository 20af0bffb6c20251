"""A candidate keeps the settings that its video was rendered with."""

from __future__ import annotations

import pytest

from lerobot_roborecover.curation.video_settings import VideoSettings, read_video_settings
from lerobot_roborecover.scenario import ScenarioError


@pytest.mark.parametrize("who", ["collect", "teleop"])
def test_the_note_of_every_command_is_read_back(who):
    video = VideoSettings(16, {"render_quality": "fast", "assets_dir": "/somewhere"})
    found = read_video_settings({"other": "text", who: {"film": video.note()}}, "here")
    assert found == VideoSettings(16, {"render_quality": "fast"})
    assert read_video_settings({}, "here") == read_video_settings({who: {}}, "here") == VideoSettings()


@pytest.mark.parametrize("note", ["every", {"every": 0}, {"every": "2"}, {"every": 1, "options": 3}])
def test_a_note_that_is_none(note):
    with pytest.raises(ScenarioError, match="here says it was rendered"):
        read_video_settings({"collect": {"film": note}}, "here")
