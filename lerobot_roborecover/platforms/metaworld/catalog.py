"""Meta-World's tasks, groups and instructions, from LeRobot's own list without importing it."""

from __future__ import annotations

import importlib.util
import json
from functools import cache
from pathlib import Path

from lerobot_roborecover.platforms.catalog import nearest
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import ScenarioError

HORIZON = 500
"""S of every task (`max_path_length` of metaworld 3.0.0)."""


@cache
def metaworld_tasks() -> dict[str, list[str]]:
    """Task names by LeRobot's difficulty group.

    Raises:
        SimulatorError: LeRobot is not installed.
    """
    return {suite: list(names) for suite, names in _metaworld_config()["DIFFICULTY_TO_TASKS"].items()}


def metaworld_instruction(name: str) -> str:
    """LeRobot's description of a Meta-World task.

    Raises:
        ScenarioError: there is no such task.
    """
    descriptions = _metaworld_config()["TASK_DESCRIPTIONS"]
    if name not in descriptions:
        raise ScenarioError(f"metaworld has no task {name!r}{nearest(name, descriptions)}")
    return descriptions[name]


@cache
def _metaworld_config() -> dict:
    spec = importlib.util.find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        raise SimulatorError("LeRobot is not installed. Install it with: pip install 'lerobot>=0.6.1'")
    path = Path(next(iter(spec.submodule_search_locations))) / "envs" / "metaworld_config.json"
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SimulatorError(f"LeRobot has no {path}; LeRobot 0.6.1 has it") from None
