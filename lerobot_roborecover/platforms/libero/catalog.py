"""LIBERO's tasks, read from hf-libero's own lists without importing it, and the predicates of their goals
with an order in which they can be reached one after the other."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from functools import cache

from lerobot_roborecover.platforms.libero.assets import package_root
from lerobot_roborecover.platforms.simulator import SimulatorError

LIBERO_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
"""The suites of the benchmark; hf-libero also has the training suite libero_90."""

LIBERO_HORIZONS = {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520}
"""S, new steps a trial may take (the paper's release; LeRobot's own table says 280 for Spatial)."""

GOAL_KINDS = ("on", "in", "open", "close", "turnon")
"""Every predicate of the four suites' goals."""
PLACE_KINDS = ("on", "in")
"""Those about where an object is."""
PREDICATES = {"turnon": 0, "open": 0, "on": 1, "in": 1, "close": 2, "turnoff": 2}
"""Predicates of a goal that the controllers know, and when their turn comes."""


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


def turn_of(predicate: Sequence[str]) -> int:
    """When a predicate's turn comes, the lowest first."""
    return PREDICATES.get(predicate[0], 1)


def workable_order(predicates: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """LIBERO's order, but what is opened or turned on comes first, and what is closed comes last.

    Args:
        predicates: each with its arguments, e.g. `("in", "mug_1", "microwave_1_heating_region")`.
    """
    return [tuple(p) for p in sorted(predicates, key=turn_of)]
