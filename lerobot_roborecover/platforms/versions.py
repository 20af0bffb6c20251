"""Package versions on which scores depend, and what of them is not met here. Reads metadata only."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata

from lerobot_roborecover.platforms import platform_named

LEROBOT = "0.6.1"
"""The LeRobot that this package is made for; `pyproject.toml` pins the same."""


def installed(distribution: str) -> str | None:
    """Version of an installed distribution; None when it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def required(platform: str) -> Mapping[str, tuple[str, ...]]:
    """Distribution names and the versions whose scores can be compared with published ones."""
    return platform_named(platform).required_versions


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
        elif found not in versions:
            problems.append(
                f"{distribution} is {found}; {platform} scores require {wanted}: "
                f"pip install '{distribution}=={versions[0]}'"
            )
    return problems


def lerobot_note() -> str | None:
    """One line on the LeRobot that is installed, with what to do; None where it is the known one."""
    found = installed("lerobot")
    if found == LEROBOT:
        return None
    here = f"this is LeRobot {found}" if found else "LeRobot is not installed as a package"
    return (
        f"lerobot_env_roborecover is made for LeRobot {LEROBOT}, and {here}: pip install "
        f"'lerobot=={LEROBOT}'; or, to go on with this one, see what differs in docs/lerobot_main.md, and "
        "score with --env.strict_versions=false"
    )
