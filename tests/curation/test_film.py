"""How a candidate was filmed travels with it, whoever recorded it."""

from __future__ import annotations

import pytest

from lerobot_roborecover.curation.film import Film, read_film
from lerobot_roborecover.scenario import ScenarioError


@pytest.mark.parametrize("who", ["collect", "teleop"])
def test_the_note_of_whoever_recorded_it_is_read_back(who):
    film = Film(16, {"render_quality": "fast", "assets_dir": "/somewhere"})
    found = read_film({"other": "text", who: {"film": film.note()}}, "here")
    assert found == Film(16, {"render_quality": "fast"})
    assert read_film({}, "here") == read_film({who: {}}, "here") == Film()


@pytest.mark.parametrize("note", ["every", {"every": 0}, {"every": "2"}, {"every": 1, "options": 3}])
def test_a_note_that_is_none(note):
    with pytest.raises(ScenarioError, match="here says it was filmed"):
        read_film({"collect": {"film": note}}, "here")
