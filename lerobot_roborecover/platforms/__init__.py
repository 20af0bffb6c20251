"""Platforms by name: ours, and those that other distributions register.

Each is imported only when it is asked for, and its simulator only when one is made.
"""

from __future__ import annotations

import importlib
import logging
from functools import cache
from typing import Any

from lerobot_roborecover.platforms.base import Platform, SimulatorSetup
from lerobot_roborecover.platforms.registry import BUILT_IN, ENTRY_POINTS, ROBOT, platform_names, registered
from lerobot_roborecover.platforms.simulator import Observation, Simulator, SimulatorError
from lerobot_roborecover.scenario import ScenarioError, TrialStart

_FAMILY = "lerobot_"
"""Of names of the one family: `lerobot_<env type>`."""

_LOG = logging.getLogger(__name__)


def resolve_rewind_steps(scenario: TrialStart, steps: int | None) -> int:
    """Returns how many steps a rollback on a scenario goes back, before the task's start limits them.

    Args:
        scenario: whose platform and horizon decide the paper's number.
        steps: a number; None takes the paper's.
    """
    if steps is not None:
        return steps
    return platform_named(scenario.platform).rewind_steps(scenario.task.horizon)


def platform_named(name: str) -> Platform:
    """A platform.

    Args:
        name: e.g. `libero`.

    Raises:
        ScenarioError: no installed distribution has one of this name, or it is not usable.
    """
    found = _load(name) if isinstance(name, str) else None
    if found is None:
        raise ScenarioError(
            f"there is no platform {str(name)[:80]!r}; there are {', '.join(platform_names())}. Those "
            f"of other distributions register under the entry point {ENTRY_POINTS!r}: is theirs installed?"
        )
    return found


def all_platforms() -> tuple[Platform, ...]:
    """All that can be loaded; one that cannot is named in a warning."""
    found = []
    for name in platform_names():
        try:
            found.append(platform_named(name))
        except ScenarioError as err:
            _LOG.warning("%s", err)
    return tuple(found)


def make_simulator(platform: str, **options: Any) -> Simulator:
    """Makes the platform's simulator.

    Args:
        platform: its name.
        options: the simulator's own keyword options, plain JSON values.

    Raises:
        SimulatorError: the platform is unknown, or its packages are not installed.
    """
    try:
        found = platform_named(platform)
    except ScenarioError as err:
        raise SimulatorError(str(err)) from None
    return found.make_simulator(**options)


@cache
def _load(name: str) -> Platform | None:
    if name in (*BUILT_IN, ROBOT):
        return importlib.import_module(f"lerobot_roborecover.platforms.{name}").PLATFORM
    if name.startswith(_FAMILY) and name not in registered():
        from lerobot_roborecover.platforms.lerobot import member

        return member(name)
    entry = registered().get(name)
    if entry is None:
        return None
    of = f"platform {name!r} of {entry.dist.name if entry.dist else 'a distribution'} ({entry.value})"
    try:
        found = entry.load()
        found = found() if isinstance(found, type) else found
    except Exception as err:  # a third-party import may raise anything
        raise ScenarioError(f"{of} cannot be loaded: {type(err).__name__}: {err}") from err
    if not isinstance(found, Platform) or found.name != name:
        what = f"is called {found.name!r}" if isinstance(found, Platform) else f"is a {type(found).__name__}"
        raise ScenarioError(f"{of} {what}; it must be a lerobot_roborecover.Platform of that name")
    return found


__all__ = [
    "BUILT_IN",
    "Observation",
    "Platform",
    "Simulator",
    "SimulatorError",
    "SimulatorSetup",
    "all_platforms",
    "make_simulator",
    "platform_named",
    "platform_names",
]
