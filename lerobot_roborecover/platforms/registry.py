"""The names of all platforms, without importing any: Gymnasium's ids are made of them."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points

ENTRY_POINTS = "roborecover.platforms"
"""Entry-point group: `name = "module:PLATFORM"`, an instance of `Platform`, or the class."""
BUILT_IN = ("libero", "metaworld", "robotwin", "fake", "lerobot")
ENV_PREFIX = "roborecover_"
"""Of every env type."""
_ENV_TYPES = {"lerobot": "wrapped"}
"""Documented names of env types that are not the platform's; `roborecover_<platform>` works as well."""
WRAPPED = ENV_PREFIX + _ENV_TYPES["lerobot"]
"""Env type that runs any of LeRobot's own."""
ROBOT = "robot"
"""Recovery points on real robots: known by name, and in no list, because it has no simulator."""
FAMILY_MEMBERS = ("lerobot_pusht", "lerobot_aloha")
"""Platforms of the `lerobot` family that are known without LeRobot: `lerobot_<env type>`."""


def platform_names() -> tuple[str, ...]:
    """All names: ours first, the known env types of LeRobot's, then those of other distributions."""
    return (*BUILT_IN, *FAMILY_MEMBERS, *registered())


def env_type_of(name: str) -> str:
    """Returns the env type of a platform, as it is documented: `roborecover_<name>` for most.

    Args:
        name: the platform's, or its `env_name`.
    """
    return ENV_PREFIX + _ENV_TYPES.get(name, name)


def platform_of(env_type: str) -> str:
    """Returns the platform's name that an env type stands for; takes documented and earlier names."""
    name = env_type.removeprefix(ENV_PREFIX)
    return next((platform for platform, documented in _ENV_TYPES.items() if documented == name), name)


@cache
def registered() -> dict[str, EntryPoint]:
    """Entry points by name, those with a name of ours aside: it stays ours."""
    return {e.name: e for e in entry_points(group=ENTRY_POINTS) if e.name not in BUILT_IN}
