"""Marks of LIBERO's goals among the bodies: where each object is wanted, and what reads them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_roborecover.curation.annotation.traces import traces
from lerobot_roborecover.platforms.simulator import GOAL_OF, HANDLE, is_mark
from lerobot_roborecover.replay.recorder import Recorder
from lerobot_roborecover.scenario import Reset

pytestmark = [pytest.mark.libero, pytest.mark.slow]


def task_named(part: str):
    from lerobot_roborecover.platforms.libero.platform import PLATFORM

    return next(t for t in PLATFORM.tasks() if part in f"{t.suite}/{t.name}")


@pytest.mark.nightly
def test_an_object_that_is_placed_on_another_is_wanted_where_that_one_is(simulator):
    task = task_named("libero_goal/put_the_bowl_on_the_plate")
    simulator.reset(task, Reset(seed=7, init_state_index=0))
    poses = simulator.bodies()
    marks = [name for name in poses if is_mark(name)]
    assert marks == ["akita_black_bowl_1_main" + GOAL_OF]
    assert poses[marks[0]].position_m == poses["plate_1_main"].position_m
    assert set(marks[0].removesuffix(GOAL_OF).split()) <= set(poses)


@pytest.mark.nightly
def test_each_of_two_goals_has_its_mark_and_the_traces_show_both(simulator):
    from lerobot_roborecover.platforms.libero.platform import PLATFORM

    task = task_named("put_both_the_alphabet_soup_and_the_tomato_sauce")
    recorder = Recorder(simulator)
    recorder.reset(task, Reset(seed=7, init_state_index=0))
    for _ in range(3):
        recorder.step(PLATFORM.no_op())
    shown = traces("libero", np.array(recorder.actions), recorder.steps, 20.0)
    goals = {name for name, place in shown.places.items() if place.goal_m is not None}
    assert goals == {"alphabet_soup_1_main", "tomato_sauce_1_main"}
    assert list(shown.places)[:2] == sorted(goals)
    inside = simulator.libero_env.sim.data.get_site_xpos("basket_1_contain_region")
    wanted = simulator.bodies()["alphabet_soup_1_main" + GOAL_OF].position_m
    assert np.array_equal(wanted, inside)


@pytest.mark.nightly
def test_a_drawer_is_wanted_where_it_is_closed_by_its_handle(simulator):
    simulator.reset(task_named("put_the_black_bowl_in_the_bottom_drawer"), Reset(seed=7, init_state_index=0))
    poses = simulator.bodies()
    drawer = "white_cabinet_1_cabinet_bottom"
    assert {name for name in poses if is_mark(name)} == {
        drawer + HANDLE, drawer + GOAL_OF, "akita_black_bowl_1_main" + GOAL_OF,
    }  # fmt: skip
    assert 0.1 < poses[drawer + HANDLE].distance_m(poses[drawer + GOAL_OF]) < 0.2, "it stands open"
    joint = simulator.libero_env.sim.data._data.joint("white_cabinet_1_bottom_level")
    joint.qpos[0] = 0.0
    mujoco.mj_kinematics(simulator.libero_env.sim.model._model, simulator.libero_env.sim.data._data)
    shut = simulator.bodies()
    assert shut[drawer + HANDLE].distance_m(shut[drawer + GOAL_OF]) < 1e-6
    assert shut[drawer + GOAL_OF].distance_m(poses[drawer + GOAL_OF]) < 1e-3, "the place stays where it is"


@pytest.mark.nightly
def test_a_goal_about_what_turns_has_no_mark(simulator):
    simulator.reset(task_named("libero_goal/turn_on_the_stove"), Reset(seed=7, init_state_index=0))
    assert not any(map(is_mark, simulator.bodies()))
