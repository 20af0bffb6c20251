"""The names of all platforms, without importing any: Gymnasium's ids are made of them."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points

ENTRY_POINTS = "roborecover.platforms"
"""Entry-point group: `name = "module:PLATFORM"`, an instance of `Platform`, or the class."""
BUILT_IN = ("libero", "metaworld", "robotwin", "fake", "lerobot")
FAMILY_MEMBERS = ("lerobot_pusht", "lerobot_aloha")
"""Platforms of the `lerobot` family that are known without LeRobot: `lerobot_<env type>`."""


def platform_names() -> tuple[str, ...]:
    """All names: ours first, the known env types of LeRobot's, then those of other distributions."""
    return (*BUILT_IN, *FAMILY_MEMBERS, *registered())


@cache
def registered() -> dict[str, EntryPoint]:
    """Entry points by name, those with a name of ours aside: it stays ours."""
    return {e.name: e for e in entry_points(group=ENTRY_POINTS) if e.name not in BUILT_IN}
