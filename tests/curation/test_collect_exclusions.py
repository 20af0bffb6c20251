"""Exclusion rules of a collection, and what a disturbance touched."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.curation.collect import exclusions as rules
from lerobot_roborecover.curation.collect.judge import (
    TOUCHED_TILT_DEG,
    scene_disturbance,
)
from lerobot_roborecover.curation.collect.record import (
    Record,
    RecorderSettings,
)
from lerobot_roborecover.platforms.limits import Workspace
from lerobot_roborecover.replay.recorder import PERTURBED, Steps
from lerobot_roborecover.scenario import Reset, ScenarioError


def record_of(path, *, puck=None, actions=None, margin=None, flags=None, settle=2):
    """A record whose end effector follows a path, (T + 1, 3)."""
    path = np.asarray(path, dtype=np.float64)
    count = len(path) - 1
    puck = np.zeros((count + 1, 3)) if puck is None else np.asarray(puck, dtype=np.float64)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count + 1, 1))
    bodies = {
        "eef": np.hstack([path, upright]), "puck": np.hstack([puck, upright]),
        "puck.handle": np.hstack([puck - 9, upright]), "goal": np.hstack([puck - 9, upright]),
    }  # fmt: skip
    return Record(
        Reset(seed=0, settle_steps=settle),
        np.zeros((count, 4)) if actions is None else actions,
        Steps(bodies, np.zeros(count + 1, bool), np.zeros(count, np.int8) if flags is None else flags),
        np.full(count + 1, np.inf) if margin is None else margin,
        Workspace((-1, -1, -1), (1, 1, 1), 0.0),
    )


def line(count=202, step=0.004):
    """A smooth way out and back, 1 mm to 4 mm a step."""
    t = np.arange(count)
    return np.stack([0.2 * np.sin(t * step / 0.2), np.zeros(count), np.zeros(count)], axis=1)


def test_an_ordinary_rollout_passes():
    assert rules.judge(record_of(line())) is None


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_erratic_motion(share):
    sign = (
        np.where(np.arange(201) % round(1 / share * 2) < 2, -1, 1) if share < 0.5 else (-1) ** np.arange(201)
    )
    path = np.concatenate([[[0, 0, 0]], np.cumsum(sign[:, None] * [[0.004, 0, 0]], axis=0)])
    found = rules.judge(record_of(path), only=("erratic",))
    assert (found is not None) == (share == 0.5)
    perturbed = np.full(201, PERTURBED, np.int8)  # noise on purpose is no fault
    assert rules.judge(record_of(path, flags=perturbed), only=("erratic",)) is None


@pytest.mark.parametrize(("steps", "out"), [(rules.OUTSIDE_STEPS - 1, False), (rules.OUTSIDE_STEPS, True)])
def test_out_of_region(steps, out):
    path = line()
    path[50 : 50 + steps, 1] = 1.0 + rules.OUTSIDE_M + 0.001
    found = rules.judge(record_of(path))
    assert (found is not None and found.rule == "outside") == out
    if out:
        assert f"{steps} steps" in found.detail


@pytest.mark.parametrize(
    ("depth", "out"), [(-rules.FALLEN_M + 0.001, False), (-rules.FALLEN_M - 0.001, True)]
)
def test_off_the_table(depth, out):
    puck = np.zeros((202, 3))
    puck[120:, 2] = depth
    found = rules.judge(record_of(line(), puck=puck))
    assert (found is not None and found.rule == "fallen") == out
    if out:
        assert "from step 120" in found.detail
        assert rules.judge(record_of(line(), puck=puck), skip=("fallen",)) is None
    under = np.full((202, 3), -0.5)  # a drawer's box, say, that belongs there
    assert rules.judge(record_of(line(), puck=under)) is None


def test_irreversible_is_moved_at_rest_and_out_of_reach():
    puck = np.zeros((202, 3))
    puck[60:, 0] = 1.0 + rules.OUT_OF_REACH_M + 0.01
    found = rules.judge(record_of(line(), puck=puck))
    assert found.rule == "irreversible"
    rolling = puck.copy()
    rolling[-20:, 0] += np.arange(20) * 0.01
    assert rules.judge(record_of(line(), puck=rolling)) is None
    beyond = np.zeros((202, 3))
    beyond[:, 0] = 1.2  # there from the start
    assert rules.judge(record_of(line(), puck=beyond)) is None


@pytest.mark.parametrize(("steps", "out"), [(rules.LIMIT_STEPS - 1, False), (rules.LIMIT_STEPS, True)])
def test_stuck_at_a_joint_limit(steps, out):
    path, margin = line(), np.full(202, 0.5)
    path[-steps - 30 :] = path[-1]
    margin[-steps:] = 0.0
    found = rules.judge(record_of(path, margin=margin))
    assert (found is not None and found.rule == "joint-limit") == out
    moving = rules.judge(record_of(line(), margin=margin))
    assert moving is None
    unknown = rules.judge(record_of(path, margin=np.full(202, np.nan)))
    assert unknown is None


@pytest.mark.parametrize(("moves", "out"), [(0.25, False), (0.15, True)])
def test_pressing_without_moving(moves, out):
    path = line()
    path[round(2 + 199 * moves) :] = path[round(2 + 199 * moves)] + [0.0, 0.5, 0.0]
    actions = np.tile([0.0, 0.0, -1.0, 0.0], (201, 1))
    found = rules.judge(record_of(path, actions=actions))
    assert (found is not None and found.rule == "pressing") == out
    assert rules.judge(record_of(path)) is None  # no action moves it


def test_rules_are_known_by_name():
    with pytest.raises(ScenarioError, match="erratic"):
        rules.check_rules("--no-exclude", ["jerk"])
    rules.check_rules("--no-exclude", list(rules.RULES))


# --- what a disturbance touched


def test_touched_is_what_ends_off_its_undisturbed_path():
    carried = np.zeros((202, 3))
    carried[100:, 0] = np.linspace(0, 0.3, 102)
    twin = record_of(line(), puck=carried)
    left = np.zeros((202, 3))  # missed: where it was, which the twin's path begins with
    assert scene_disturbance(record_of(line(), puck=left), twin).displaced_mm == 0
    let_go = carried.copy()
    let_go[150:] = [carried[150, 0], 0.0, 0.0]  # somewhere on its path
    assert scene_disturbance(record_of(line(), puck=let_go), twin).displaced_mm == 0
    aside = carried.copy()
    aside[150:] = [carried[150, 0], 0.04, 0.0]
    touch = scene_disturbance(record_of(line(), puck=aside), twin)
    assert (touch.body, touch.displaced_mm) == ("puck", pytest.approx(40))
    tipped = record_of(line(), puck=left)
    angle = np.radians(TOUCHED_TILT_DEG + 5)
    tipped.steps.bodies["puck"][-1, 3:] = [np.sin(angle / 2), 0, 0, np.cos(angle / 2)]
    assert scene_disturbance(tipped, twin).tilted_deg == pytest.approx(TOUCHED_TILT_DEG + 5)


def test_settings_are_plain_values():
    assert RecorderSettings().perturbed_steps == 150  # the paper's
