"""The names of platforms, which are listed without importing any."""

from lerobot_roborecover.platforms import lerobot, platform_named
from lerobot_roborecover.platforms.registry import BUILT_IN, FAMILY_MEMBERS


def test_the_listed_members_of_the_lerobot_family_are_those_it_knows():
    assert lerobot.PLATFORM.members() == FAMILY_MEMBERS


def test_every_listed_name_is_a_platforms():
    assert [platform_named(name).name for name in BUILT_IN if name != "lerobot"] == [*BUILT_IN[:-1]]
