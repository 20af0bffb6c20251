"""Which object the rules take for the handled one where a task wants several somewhere."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.curation.annotation.annotators import LABELERS
from lerobot_roborecover.curation.annotation.features import EpisodeFeatures, EpisodeInfo
from lerobot_roborecover.curation.annotation.rules import _Seen

FRAMES = range(0, 40, 2)


def look(
    reach: dict[str, float], goal: dict[str, float], *, human: bool = False, paused: range = range(0)
) -> EpisodeFeatures:
    """A look of constant distances; the hand stands still at some frames."""
    made = EpisodeFeatures(EpisodeInfo("it", "", FRAMES[-1], 20.0, False, human=human))
    for f in FRAMES:
        made.readings[f] = {"hand": {"speed": 0.0 if f in paused else 0.5, "a6": 1.0}}
        for name in reach:
            values = {"reach": reach[name], "moved": 0.0, "height": 0.0}
            made.readings[f][name] = values | ({"goal": goal[name]} if name in goal else {})
    return made


@pytest.mark.parametrize(
    ("reach", "goal", "handled"),
    [
        ({"soup": 0.3, "sauce": 0.1}, {"soup": 0.4, "sauce": 0.4}, "sauce"),
        ({"soup": 0.3, "sauce": 0.1}, {"soup": 0.4, "sauce": 0.02}, "soup"),  # the sauce is where it belongs
        ({"soup": 0.3, "sauce": 0.1}, {"soup": 0.01, "sauce": 0.02}, "sauce"),
        ({"soup": 0.3, "plate": 0.05}, {"soup": 0.4}, "soup"),
    ],
)
def test_of_several_objects_with_goals_it_is_the_nearest_that_is_not_there_yet(reach, goal, handled):
    assert _Seen(look(reach, goal), LABELERS["auto-1"]).main == handled


def test_of_a_human_made_rollout_it_is_judged_where_the_person_stopped():
    made = look({"soup": 0.1, "sauce": 0.3}, {"soup": 0.4, "sauce": 0.4}, human=True, paused=range(8, 24))
    for f in FRAMES:
        if f > 24:  # both are placed in the end, the sauce last
            made.readings[f]["soup"] |= {"goal": 0.01, "reach": 0.4}
            made.readings[f]["sauce"] |= {"goal": 0.01, "reach": 0.1}
    assert _Seen(made, LABELERS["auto-1"]).main == "soup"
    assert np.isfinite(_Seen(made, LABELERS["auto-1"]).goal).all()
