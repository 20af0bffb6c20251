"""RoboTwin behind the simulator protocol: exact replays, RoboTwin's own rules, and nothing left behind.

On the stand-in by default; on RoboTwin's own code where ROBOTWIN_ROOT names a checkout.
"""

from __future__ import annotations

import random

import numpy as np
import pytest

from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.robotwin.platform import STEP_LIMITS
from lerobot_roborecover.replay.handoff import hand_off, with_fingerprint
from lerobot_roborecover.scenario import Outcome, Reset, Scenario, Task
from tests.support.robotwin_checkouts import (
    REAL,
    ROOT,
    STANDIN,
    TASKS,
    on_real,
    on_standin,
    resident_kb,
    run_fresh,
)

pytestmark = pytest.mark.robotwin


def task_of(name: str, suite: str = "demo_clean") -> Task:
    return Task("robotwin", suite, name, "Stack the green block on the red block.", STEP_LIMITS[name])


STACK = task_of("stack_blocks_two")


def wander(start: np.ndarray, steps: int, seed: int = 0) -> np.ndarray:
    """(steps, 14) float64 joint targets that drift about from `start`, beyond 1 rad where they get there."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.uniform(-0.06, 0.06, (steps, 14)), axis=0)
    actions = start + drift
    actions[:, [6, 13]] = rng.uniform(0, 1, (steps, 2))
    return actions


@pytest.fixture(scope="module")
def simulator():
    made = make_simulator("robotwin", robotwin_root=ROOT, obs_type="state")
    yield made
    made.close()


def solution(simulator, task: Task = STACK, seed: int = 3) -> np.ndarray:
    """(T, 14) the expert's actions from a reset to success."""
    from recipes.robotwin.expert import BlockExpert
    from recipes.robotwin.plans import solve

    simulator.reset(task, Reset(seed=seed))
    actions = []
    for action in solve(BlockExpert(simulator), "stack_blocks_two"):
        simulator.step(action)
        actions.append(action)
        if simulator.succeeded():
            break
    return np.array(actions)


@pytest.fixture(scope="module")
def solved(simulator):
    actions = solution(simulator)
    assert simulator.succeeded()
    return actions


def scenario_of(prefix: np.ndarray, seed: int = 3, **changes) -> Scenario:
    labels = {"stage": "Approach", "deviation": "Wrong Pose", "source": "perturbed"}
    return Scenario(id="s", task=STACK, reset=Reset(seed=seed), prefix=prefix, **{**labels, **changes})


def test_limits_are_the_official_ones(simulator):
    limits = simulator.checkout.step_limits
    assert limits == {name: STEP_LIMITS[name] for name in limits}
    assert set(TASKS) <= set(limits)


@on_real
def test_every_task_has_code_and_an_official_limit(simulator):
    assert simulator.checkout.step_limits == STEP_LIMITS
    assert {t for t in STEP_LIMITS if not simulator.checkout.missing_objects(t)} >= set(TASKS)


@pytest.mark.nightly
@pytest.mark.parametrize("name", TASKS)
def test_replays_are_bit_identical_in_this_process_and_in_a_fresh_one(simulator, name, tmp_path):
    steps = 200 if REAL else 40
    task, other = task_of(name), task_of(TASKS[1] if name == TASKS[0] else TASKS[0])
    simulator.reset(task, Reset(seed=4))
    first = simulator.bodies()
    actions = wander(simulator.robotwin_task.joint_state(), steps)
    for action in actions:
        simulator.step(action)
    state, bodies = simulator.state_sha256(), simulator.bodies()
    assert any(first[n].distance_m(bodies[n]) > 1e-3 for n in first), "the actions moved nothing"

    simulator.reset(other, Reset(seed=9))
    simulator.step(actions[0])
    simulator.reset(task, Reset(seed=4))
    assert simulator.bodies() == first
    for action in actions:
        simulator.step(action)
    assert simulator.state_sha256() == state
    assert simulator.bodies() == bodies

    np.save(tmp_path / "actions.npy", actions)
    script = f"""
import numpy as np
from lerobot_roborecover.scenario import Reset, Task
from lerobot_roborecover.platforms import make_simulator
s = make_simulator("robotwin", robotwin_root={ROOT!r}, obs_type="state")
s.reset(Task("robotwin", "demo_clean", {name!r}, "x", 100), Reset(seed=4))
for a in np.load({str(tmp_path / "actions.npy")!r}): s.step(a)
print(s.state_sha256())
"""
    fresh = run_fresh(script).split()[-1]
    print(f"{name}: {steps} actions, state {state[:16]}; in a fresh process {fresh[:16]}")
    assert fresh == state


@pytest.mark.nightly
def test_contact_solves_the_task_and_a_miss_does_not(simulator, solved):
    simulator.reset(STACK, Reset(seed=3))
    for action in solved:
        assert not simulator.succeeded()
        simulator.step(action)
    assert simulator.succeeded()

    missed = solved.copy()
    missed[:, [6, 13]] = np.maximum(missed[:, [6, 13]], 0.9)  # grippers that never close
    simulator.reset(STACK, Reset(seed=3))
    for action in missed:
        simulator.step(action)
    assert not simulator.succeeded()


def test_a_prefix_that_solves_the_task_is_said_to(simulator, solved):
    handoff = hand_off(simulator, scenario_of(solved))
    assert handoff.problem is Outcome.SOLVED_BY_PREFIX


def test_a_handoff_is_exact_and_a_displaced_one_refused(simulator, solved):
    scenario = with_fingerprint(simulator, scenario_of(solved[: len(solved) // 2]))
    handoff = hand_off(simulator, scenario)
    assert handoff.identical is True
    assert (handoff.eef_error_mm, handoff.object_error_mm, handoff.problem) == (0.0, 0.0, None)
    off = scenario.prefix.copy()
    off[-1, 0] += 0.2
    handoff = hand_off(simulator, scenario_of(off, fingerprint=scenario.fingerprint))
    assert handoff.problem is Outcome.STATE_MISMATCH


def test_replayed_actions_do_not_use_up_the_official_limit(simulator, solved):
    simulator.reset(STACK, Reset(seed=3))
    simulator.robotwin_task.task.take_action_cnt = STACK.horizon  # RoboTwin would ignore every further action
    for action in solved:
        simulator.step(action)
    assert simulator.succeeded()


def test_arms_are_not_clipped(simulator):
    simulator.reset(STACK, Reset(seed=3))
    action = simulator.robotwin_task.joint_state()
    action[3] = 1.7
    simulator.step(action)
    state = simulator.observe()["agent_pos"]
    assert state.dtype == np.float32
    assert state.shape == (14,)
    assert state[3] == pytest.approx(1.7, abs=0.01)


def test_the_callers_random_streams_are_untouched_and_the_tasks_own_go_on(simulator):
    torch = pytest.importorskip("torch")
    random.seed(5)
    np.random.seed(5)
    torch.manual_seed(5)
    expected = (random.random(), np.random.rand(), torch.rand(1).item())
    random.seed(5)
    np.random.seed(5)
    torch.manual_seed(5)
    simulator.reset(STACK, Reset(seed=3))
    simulator.step(simulator.robotwin_task.joint_state() + 0.01)
    assert (random.random(), np.random.rand(), torch.rand(1).item()) == expected


def test_a_snapshot_restores_the_state_but_is_not_called_exact(simulator, solved):
    assert simulator.snapshot_is_exact is False
    simulator.reset(STACK, Reset(seed=3))
    for action in solved[:15]:
        simulator.step(action)
    state, snapshot = simulator.state_sha256(), simulator.snapshot()
    for action in solved[15:20]:
        simulator.step(action)
    assert simulator.state_sha256() != state
    simulator.restore(snapshot)
    assert simulator.state_sha256() == state


def test_bodies_name_both_arms_and_every_block(simulator):
    simulator.reset(STACK, Reset(seed=3))
    bodies = simulator.bodies()
    assert set(bodies) == {"eef_left", "eef_right", "block1", "block2"}
    assert bodies["eef_left"].position_m[0] < bodies["eef_right"].position_m[0]


@pytest.mark.nightly
def test_twenty_trials_in_one_process_do_not_grow(simulator, solved):
    def trial(seed: int) -> int:
        simulator.reset(STACK, Reset(seed=seed))
        for action in solved[:5]:
            simulator.step(action)
        return resident_kb()

    for seed in (0, 1, 2):
        trial(seed)
    start = trial(3)
    end = [trial(seed) for seed in (*range(4, 13), *range(14, 25))][-1]
    print(f"memory: {start} kB, after 20 more trials {end} kB ({100 * (end / start - 1):+.2f} %)")
    assert end < 1.05 * start


@pytest.mark.nightly
@pytest.mark.render
@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_every_quality_gives_lerobots_observation_and_the_same_physics(simulator, solved):
    simulator.reset(STACK, Reset(seed=3))
    for action in solved[:4]:
        simulator.step(action)
    state = simulator.state_sha256()
    pictures = {}
    for quality in ("trivial", "minimal", "default"):
        looking = make_simulator("robotwin", robotwin_root=ROOT, render_quality=quality)
        looking.reset(STACK, Reset(seed=3))
        for action in solved[:4]:
            looking.step(action)
        assert looking.state_sha256() == state
        observation = looking.observe()
        assert looking.observation_space.contains(observation)
        assert set(observation["pixels"]) == {"head_camera", "left_camera", "right_camera"}
        pictures[quality] = observation["pixels"]["head_camera"]
        assert looking.state_sha256() == state
        assert (looking.render() == pictures[quality]).all()
        looking.close()
    assert (pictures["trivial"] != pictures["default"]).any()


@pytest.mark.nightly
@on_standin
def test_end_effector_actions_with_curobo(tmp_path):
    """In a process of its own, because a stand-in for curobo stays imported."""
    script = f"""
import numpy as np
from lerobot_roborecover.scenario import Reset, Task
from lerobot_roborecover.platforms import SimulatorError, make_simulator
s = make_simulator("robotwin", robotwin_root={str(STANDIN)!r}, obs_type="state", action_mode="ee")
assert s.action_dim == 16
s.reset(Task("robotwin", "demo_clean", "stack_blocks_two", "x", 100), Reset(seed=4))
start = s.robotwin_task.end_effectors()
goal = start.copy()
goal[2] += 0.05
s.step(goal)
assert abs(s.robotwin_task.end_effectors()[2] - goal[2]) < 2e-3
for bad in (0.0, 0.5):
    wrong = goal.copy()
    wrong[3:7] *= bad
    try:
        s.step(wrong)
    except SimulatorError as err:
        assert "quaternion" in str(err), err
    else:
        raise AssertionError("a quaternion of norm %s was taken" % bad)
s.set_control_mode("relative")
before = s.robotwin_task.end_effectors()
delta = np.zeros(16)
delta[[6, 14]] = 1.0  # no rotation, in scipy's order
delta[[7, 15]] = 1.0
delta[8] = 0.04
s.step(delta)
after = s.robotwin_task.end_effectors()
assert abs(after[8] - before[8] - 0.04) < 2e-3, (before, after)
assert np.abs(after[:3] - before[:3]).max() < 2e-3
"""
    run_fresh(script, PYTHONPATH=str(STANDIN / "curobo_standin"))


@on_real
def test_an_installed_curobo_is_used(tmp_path):
    """RoboTwin's planner is built on the importable curobo, joint control is what it was, and end-effector
    actions go through RoboTwin's own code to it. The curobo is a stand-in; the real one needs a GPU."""
    script = f"""
import numpy as np
from lerobot_roborecover.scenario import Reset, Task
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.robotwin import stubs
task = Task("robotwin", "demo_clean", "stack_blocks_two", "x", 100)
s = make_simulator("robotwin", robotwin_root={ROOT!r}, obs_type="state", action_mode="ee")
s.reset(task, Reset(seed=4))
start = s.robotwin_task.joint_state()
for _ in range(3): s.step(start + 0.05)
print(s.state_sha256())
if stubs.has_curobo():
    import torch
    import curobo.wrap.reacher.motion_gen as planner
    assert "curobo_standin" in planner.__file__ and not isinstance(planner, stubs._Stub)
    assert len(planner.MADE) >= 2, planner.MADE
    assert s.robotwin_task.task.play_once is not stubs.refuse_expert
    torch.Tensor.cuda = lambda self, *args, **kwargs: self  # RoboTwin moves its joints to the GPU
    s.reset(task, Reset(seed=4))
    before, pose = s.robotwin_task.joint_state(), s.robotwin_task.end_effectors()
    goal = pose.copy()
    goal[10] = -5.0  # the right arm cannot be planned for: RoboTwin then leaves it alone
    s.step(goal)
    moved = s.robotwin_task.joint_state() - before
    assert abs(moved[0] - planner.TURN_RAD) < 1e-4, moved
    assert np.abs(moved[[1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12]]).max() < 1e-4, moved
"""
    without = run_fresh(script).split()[-1]
    assert run_fresh(script, PYTHONPATH=str(STANDIN / "curobo_standin")).split()[-1] == without


def test_a_curobo_that_cannot_be_imported_is_said(tmp_path):
    (tmp_path / "curobo").mkdir()
    (tmp_path / "curobo" / "__init__.py").write_text("raise OSError('libcudart.so.12: cannot open')")
    script = f"""
from lerobot_roborecover.scenario import Reset, Task
from lerobot_roborecover.platforms import SimulatorError, make_simulator
s = make_simulator("robotwin", robotwin_root={ROOT!r}, obs_type="state")
try:
    s.reset(Task("robotwin", "demo_clean", "stack_blocks_two", "x", 100), Reset(seed=4))
except SimulatorError as err:
    print(err)
"""
    said = run_fresh(script, PYTHONPATH=str(tmp_path))
    assert "curobo is installed but cannot be imported (libcudart.so.12" in said
    assert "uninstall" in said
