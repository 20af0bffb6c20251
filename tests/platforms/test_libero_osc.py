"""LIBERO's steps by `osc.py` and `contacts.py` are robosuite's own, bit for bit."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero.catalog import libero_tasks
from lerobot_roborecover.platforms.mujoco_state import unpack_arrays
from lerobot_roborecover.scenario import Reset
from tests.platforms.test_libero_simulator import actions, task_of

pytestmark = pytest.mark.libero

STEPS = 24
TASKS = [(suite, index) for suite, names in libero_tasks().items() for index in range(len(names))]
SOME = [("libero_10", 2)]


@pytest.fixture(scope="module")
def sim():
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    simulator = LiberoSimulator(obs_type="state")
    yield simulator
    simulator.close()


def everything(sim) -> dict[str, object]:
    """What a step leaves behind; arrays as shape, layout and bytes."""
    task, data = sim._task, sim._task.data
    robot, controller, seen = task.robot, task.robot.controller, sim.observe()
    arrays = {name: getattr(data, name) for name in ("qpos", "qvel", "ctrl", "qacc", "qacc_warmstart")}
    arrays |= {f"snapshot {name}": value for name, value in unpack_arrays(sim.snapshot()).items()}
    arrays |= {"command": controller.torques, "torques": robot.torques, "sites": task.model.site_rgba}
    arrays |= {f"{group} {k}": v for group, of in seen["robot_state"].items() for k, v in of.items()}
    arrays["environment_state"] = seen["environment_state"]
    return {name: exactly(value) for name, value in arrays.items()} | {
        "sha256": sim.state_sha256(),
        "new_update": controller.new_update,
        "succeeded": sim.succeeded(),
    }


def exactly(value: np.ndarray | None) -> object:
    if value is None:
        return None
    value = np.asarray(value)
    layout = value.flags.c_contiguous, value.flags.f_contiguous
    return value.shape, value.dtype.str, layout, value.tobytes()


def episode(sim, task, shortcuts: bool) -> list[dict[str, object]]:
    """Pushes beyond the limits, a step back to a snapshot, then absolute targets."""
    sim.reset(task, Reset(seed=7, init_state_index=1))
    sim._task.use_shortcuts(shortcuts)
    sim._task.robot.torques = None  # of the episode before: a reset leaves them
    rows, rng = [everything(sim)], np.random.default_rng(3)
    for step, action in enumerate(actions(STEPS)):
        if step == 5:
            kept = sim.snapshot()
        if step == 9:
            sim.restore(kept)
        if step == 14:
            sim.set_control_mode("absolute")
        if step >= 14:
            near = sim._task.robot.controller.ee_pos + rng.uniform(-0.05, 0.05, 3)
            action[:6] = [*near, *rng.uniform(-3.2, 3.2, 3)]
        sim.step(action.astype(np.float32) if step in (3, 17) else action)
        rows.append(everything(sim))
    return rows


@pytest.mark.parametrize(
    ("suite", "index"),
    [pytest.param(*t, marks=[] if t in SOME else pytest.mark.nightly) for t in TASKS],
)
def test_every_step_is_robosuites_own(sim, suite, index):
    task = task_of(suite, index)
    ours = episode(sim, task, shortcuts=True)
    assert sim._task._controlled() is not None
    theirs = episode(sim, task, shortcuts=False)
    assert sim._task._controlled() is None
    for step, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        assert [name for name in b if a[name] != b[name]] == [], f"after {step} steps"
    assert len({row["sha256"] for row in ours}) > STEPS - 5, "nothing moved"


@pytest.mark.nightly
def test_a_snapshot_goes_on_with_either(sim):
    task, steps = task_of(*SOME[0]), actions(12)
    sim.reset(task, Reset(seed=7, init_state_index=1))
    for action in steps[:6]:
        sim.step(action)
    kept, ends = sim.snapshot(), []
    for shortcuts in (True, False):
        sim.restore(kept)
        sim._task.use_shortcuts(shortcuts)
        for action in steps[6:]:
            sim.step(action)
        ends.append(everything(sim))
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("impedance_mode", "variable_kp"),
        ("interpolator_pos", object()),
        ("interpolator_ori", object()),
        ("uncoupling", False),
        ("use_ori", False),
        ("qvel_index", [0, 2, 1, 3, 4, 5, 6]),
    ],
)
def test_another_controller_is_robosuites_to_run(sim, monkeypatch, option, value):
    from lerobot_roborecover.platforms.libero.osc import osc_control

    sim.reset(task_of(*SOME[0]), Reset(seed=7, init_state_index=1))
    assert osc_control(sim.libero_env) is not None
    monkeypatch.setattr(sim._task.robot.controller, option, value)
    assert osc_control(sim.libero_env) is None


def test_an_option_changed_between_steps_is_seen(sim, monkeypatch):
    task, steps = task_of(*SOME[0]), actions(6)

    def end(shortcuts: bool) -> str:
        sim.reset(task, Reset(seed=7, init_state_index=1))
        sim._task.use_shortcuts(shortcuts)
        for step, action in enumerate(steps):
            sim._task.robot.controller.uncoupling = step < 3
            sim.step(action)
        return sim.state_sha256()

    assert end(shortcuts=True) == end(shortcuts=False)
    sim._task.robot.controller.uncoupling = True


def test_another_robot_or_robosuite_is_robosuites_to_run(sim, monkeypatch):
    from lerobot_roborecover.platforms.libero import osc

    sim.reset(task_of(*SOME[0]), Reset(seed=7, init_state_index=1))
    robot = sim._task.robot
    other = type("OtherGripper", (type(robot.gripper),), {})
    with monkeypatch.context() as patched:
        patched.setattr(robot.gripper, "__class__", other)
        assert osc.osc_control(sim.libero_env) is None
    monkeypatch.setattr(osc, "_version", lambda: "1.5.0")
    assert osc.osc_control(sim.libero_env) is None


@pytest.mark.nightly
def test_contacts_are_robosuites(sim):
    """All pairs of objects and fixtures, the fingers, and names of every kind that robosuite takes."""
    sim.reset(task_of("libero_spatial", 4), Reset(seed=7, init_state_index=1))
    sim._task.use_shortcuts(True)
    env = sim.libero_env
    theirs = partial(type(env).check_contact, env)
    gripper = sim._task.robot.gripper
    pads = gripper.important_geoms["left_fingerpad"]
    objects = [env.get_object(name) for name in env.obj_body_id if name != "floor"]
    groups = [*objects, gripper, pads, tuple(pads), pads[0], "no such geom", []]
    groups += [sim._task.model.geom(i).name for i in range(0, sim._task.model.ngeom, 40)]
    seen = set()
    for action in actions(15):
        sim.step(action)
    for one in groups:
        for other in [*groups, None]:
            seen.add(answer := theirs(one, other))
            assert env.check_contact(one, other) is answer, (one, other)
    assert seen == {True, False}


@pytest.mark.nightly
def test_boxes_of_many_bodies_are_those_of_each(sim):
    from lerobot_roborecover.platforms.libero.boxes import BodyBoxes
    from lerobot_roborecover.platforms.mujoco_state import subtree

    sim.reset(task_of("libero_goal", 7), Reset(seed=7, init_state_index=1))
    for action in actions(5):
        sim.step(action)
    model, data = sim._task.model, sim._task.data
    boxes = BodyBoxes(model, [*range(1, model.nbody), 1])
    centres, halves = boxes.read(data)
    empty = 0
    for body, row in boxes.row.items():
        inside = np.isin(model.geom_bodyid, list(subtree(model, [body])))
        geoms = np.flatnonzero(inside & ((model.geom_contype | model.geom_conaffinity) > 0))
        if not len(geoms):
            empty += 1
            assert np.array_equal(centres[row], data.xpos[body])
            assert not halves[row].any()
            continue
        turns = data.geom_xmat[geoms].reshape(-1, 3, 3)
        local = model.geom_aabb[geoms]
        middle = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turns, local[:, :3])
        extent = np.einsum("gij,gj->gi", np.abs(turns), local[:, 3:])
        low, high = (middle - extent).min(axis=0), (middle + extent).max(axis=0)
        assert np.array_equal(centres[row], (low + high) / 2)
        assert np.array_equal(halves[row], (high - low) / 2)
    assert 0 < empty < len(boxes.row)
