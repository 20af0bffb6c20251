"""Package versions on which scores depend, and what of them is not met here. Reads metadata only."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.utils.lerobot_versions import version_problem

STAMPS = ("lerobot",)
"""Distributions whose version is in every row, and is distinguished, but not refused: LeRobot brings policies
and observations, and physics is in the pinned packages."""


def installed(distribution: str) -> str | None:
    """Version of an installed distribution; None when it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def required(platform: str) -> Mapping[str, tuple[str, ...]]:
    """Distribution names and the versions whose scores can be compared with published ones."""
    return platform_named(platform).required_versions


def row_versions(platform: str) -> dict[str, str]:
    """Returns what a row of the platform says of versions: those on which scores depend, and the stamps."""
    return {name: installed(name) or "" for name in (*required(platform), *STAMPS)}


def install_command(platform: str) -> str:
    """The command that installs what the platform requires."""
    return platform_named(platform).install_command


def version_problems(platform: str) -> list[str]:
    """What of the platform's requirements is not met: one sentence each, with its remedy; empty when all are.

    Raises:
        ScenarioError: the platform is unknown.
    """
    problems = []
    for distribution, versions in required(platform).items():
        found = installed(distribution)
        wanted = " or ".join(versions)
        if found is None:
            problems.append(
                f"{distribution} is not installed; {platform} scores require {wanted}: "
                f"{install_command(platform)}"
            )
        elif distribution in STAMPS:
            if note := version_problem(found):
                problems.append(note)
        elif found not in versions:
            problems.append(
                f"{distribution} is {found}; {platform} scores require {wanted}: "
                f"pip install '{distribution}=={versions[0]}'"
            )
    return problems
