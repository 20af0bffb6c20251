"""What an env type evaluates where nothing is named."""

from __future__ import annotations

import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import all_platforms, platform_named

WITH_SPLIT = [p for p in all_platforms() if p.default_split]


@pytest.mark.slow
@pytest.mark.parametrize("platform", WITH_SPLIT, ids=lambda p: p.name)
def test_of_a_default_set_its_tests_alone_are_evaluated(platform):
    source, split = platform.evaluated("", None)
    assert (source, split) == (platform.default_scenarios, platform.default_split)
    tested = load_scenarios(source, split=split)
    assert 0 < len(tested) < len(load_scenarios(source))


def test_what_is_named_is_taken_as_it_is_named():
    platform = platform_named("metaworld")
    assert platform.evaluated("elsewhere", None) == ("elsewhere", None)
    assert platform.evaluated("elsewhere", "train") == ("elsewhere", "train")
    assert platform.evaluated("", None) == ("metaworld_starter", None)
    assert platform.evaluated("", "train") == ("metaworld_starter", "train")


def test_without_a_default_the_set_has_to_be_named(monkeypatch):
    platform = platform_named("metaworld")
    monkeypatch.setattr(type(platform), "default_scenarios", "")
    with pytest.raises(OptionError, match="has no shipped scenarios"):
        platform.evaluated("", None)
