"""What each platform has: its tasks, read from the installed packages' own lists without importing them, and
the bounds of its actions."""

from __future__ import annotations

import difflib
import importlib.util
import json
import math
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np

from lerobot_roborecover.scenario import ScenarioError, Task
from lerobot_roborecover.simulators.base import SimulatorError
from lerobot_roborecover.simulators.libero_assets import package_root
from lerobot_roborecover.simulators.robotwin_limits import STEP_LIMITS

LIBERO_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
"""The suites of the benchmark; hf-libero also has the training suite libero_90."""

LIBERO_HORIZONS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520}
"""S, new steps a trial may take (the paper's release; LeRobot's own table says 280 for Spatial)."""


ACTION_BOUNDS = {"robotwin": math.inf}
"""Largest |value| of an action, where it is not 1. RoboTwin's joint targets are radians and go beyond it:
LeRobot's own Box(-1, 1) does not fit them."""


def action_space(platform: str, width: int) -> gym.spaces.Box:
    """What a policy may give a platform's simulator.

    Args:
        platform: its name.
        width: values in an action.
    """
    bound = ACTION_BOUNDS.get(platform, 1.0)
    return gym.spaces.Box(-bound, bound, (width,), np.float32)


@cache
def libero_tasks() -> dict[str, list[str]]:
    """Task names by suite, in hf-libero's order.

    Raises:
        SimulatorError: hf-libero is not installed.
    """
    path = package_root() / "benchmark" / "libero_suite_task_map.py"
    # Importing libero.libero.benchmark would bring torch, so the one data file is loaded by itself.
    spec = importlib.util.spec_from_file_location("_roborecover_libero_task_map", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise SimulatorError(f"hf-libero has no {path}; install hf-libero==0.1.4")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {suite: list(module.libero_task_map[suite]) for suite in LIBERO_SUITES}


def libero_goal(suite: str, name: str) -> list[list[str]]:
    """A LIBERO task's goal predicates, each with its arguments: `["on", "plate_1", "..."]`.

    Raises:
        SimulatorError: hf-libero lacks the task's file, or its goal is no conjunction.
    """
    from bddl.parsing import scan_tokens

    path = package_root() / "bddl_files" / suite / f"{name}.bddl"
    if not path.is_file():
        raise SimulatorError(f"hf-libero has no {path}; install hf-libero==0.1.4")
    goals = [part[1] for part in scan_tokens(filename=str(path)) if part[0] == ":goal"]
    if len(goals) != 1 or goals[0][0] != "and":
        raise SimulatorError(f"{path} has the goal {goals!r:.200}, which is not `(And ...)`")
    return goals[0][1:]


def libero_instruction(name: str) -> str:
    """The instruction LIBERO derives from a task's name: underscores to spaces, no scene prefix."""
    return re.sub(r"^[A-Z_]*SCENE\d+_", "", name).replace("_", " ")


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


def check_task(task: Task) -> None:
    """Refuses a task that its platform does not have; platforms without a catalogue here pass.

    Raises:
        ScenarioError: unknown suite or task; names the nearest ones.
        SimulatorError: the platform's package is not installed.
    """
    catalogues = {"libero": libero_tasks, "metaworld": metaworld_tasks}
    if task.platform == "robotwin" and task.name not in STEP_LIMITS:
        # The suite is one of the checkout's task configurations, which the simulator checks.
        raise ScenarioError(f"robotwin has no task {task.name!r}{nearest(task.name, STEP_LIMITS)}")
    if task.platform not in catalogues:
        return
    suites = catalogues[task.platform]()
    if task.suite not in suites:
        raise ScenarioError(f"{task.platform} has no suite {task.suite!r}; there are {', '.join(suites)}")
    if task.name not in suites[task.suite]:
        elsewhere = [s for s, names in suites.items() if task.name in names]
        hint = f"; it is a task of {elsewhere[0]}" if elsewhere else nearest(task.name, suites[task.suite])
        raise ScenarioError(f"{task.platform} suite {task.suite} has no task {task.name!r}{hint}")


@cache
def _metaworld_config() -> dict:
    spec = importlib.util.find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        raise SimulatorError("LeRobot is not installed. Install it with: pip install lerobot==0.6.1")
    path = Path(next(iter(spec.submodule_search_locations))) / "envs" / "metaworld_config.json"
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SimulatorError(f"LeRobot has no {path}; install lerobot==0.6.1") from None


def nearest(name: str, names: Iterable[str]) -> str:
    """The end of a message about a name that there is not: those that it may have meant."""
    close = difflib.get_close_matches(name, list(names), n=3, cutoff=0.4)
    return f"; nearest: {', '.join(close)}" if close else f"; there are {', '.join(sorted(names))}"
