"""Another LeRobot than the known one (`scripts/test.sh --lerobot-main`), counted as the known one: its scores
are refused, and what comes after that is to be tested, too."""

from __future__ import annotations

from importlib import metadata

from lerobot_roborecover.platforms.versions import LEROBOT

_version = metadata.version


def version(distribution: str) -> str:
    """`importlib.metadata.version`, but for LeRobot's, where it is installed."""
    return LEROBOT if distribution == "lerobot" and installed_is_another() else _version(distribution)


def installed_is_another() -> bool:
    """Whether there is a LeRobot, which is another one than ours."""
    try:
        return _version("lerobot") != LEROBOT
    except metadata.PackageNotFoundError:
        return False


def count_as_known() -> None:
    """For the rest of this process."""
    metadata.version = version
