"""Which of a platform's tasks a recording is of, from its name or its instruction."""

from __future__ import annotations

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Task


def task_by_name(platform: str, name: str, instruction: str = "", suite: str = "") -> Task:
    """See `Platform.task`."""
    return platform_named(platform).task(name, instruction, suite)


def task_by_instruction(platform: str, instruction: str, suite: str = "") -> Task:
    """See `Platform.task_by_instruction`."""
    return platform_named(platform).task_by_instruction(instruction, suite)
