"""LIBERO's scripted controllers: each kind solves a task of its own, from the start and from the middle."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero import PLATFORM
from lerobot_roborecover.platforms.starts import Starts
from recipes.libero.expert_success import solve, spread_inits, table, tasks_named

pytestmark = pytest.mark.libero

KINDS = {
    "goal:0": "a drawer is pulled open",
    "10:3": "a drawer is pushed closed over what was put inside",
    "10:8": "two pots stand beside one another",
    "10:9": "a mug goes into a microwave and its door is pushed closed",
    "goal:5": "a plate slides",
    "goal:7": "a knob is turned",
    "goal:8": "a bowl is put down beside a cabinet",
}


def start(number: str, init: int):
    (task,) = tasks_named(number)
    return task, PLATFORM.resets(task, Starts(init_states=(init,)))[0]


@pytest.mark.nightly
@pytest.mark.parametrize("number", KINDS)
def test_each_kind_of_goal_is_solved(simulator, number):
    task, reset = start(number, 1)
    assert PLATFORM.unsupported_reason(task) == ""
    assert solve(simulator, task, reset, "scripted") is not None


@pytest.mark.nightly
def test_a_knob_is_turned_from_the_middle(simulator):
    """A controller that starts with the fingers closed on nothing, low over the table."""
    task, reset = start("goal:7", 2)
    simulator.reset(task, reset)
    for _ in range(12):
        simulator.step(np.array([0.2, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]))
    act = PLATFORM.experts["scripted"].make(simulator, task, np.random.default_rng(0))
    for step in range(task.horizon):
        simulator.step(act(step))
        if simulator.succeeded():
            return
    pytest.fail("the knob was not turned")


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("suite", ["spatial", "object", "goal", "10"])
def test_most_tasks_are_solved(simulator, suite):
    good = 0
    for task in tasks_named(suite):
        resets = PLATFORM.resets(task, Starts(init_states=spread_inits(5)))
        good += sum(solve(simulator, task, reset, "scripted") is not None for reset in resets) >= 4
    assert good >= 9


def test_the_table_counts():
    tasks = tasks_named("goal:0,goal:7")
    rows = [{"suite": t.suite, "task": t.name, "steps": s} for t, s in zip(tasks, (80, None), strict=True)]
    lines = table(tasks, rows).splitlines()
    assert lines[2].startswith("| goal:0 | open the middle drawer")
    assert lines[2].endswith("| 1/1 | 80 | 300 |")
    assert lines[3].endswith("| 0/1 |  | 300 |")
    assert lines[-1].startswith("1 of 2 tasks")
