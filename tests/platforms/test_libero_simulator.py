"""LIBERO: exact resets, steps, snapshots and observations, against robosuite's and LeRobot's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero.assets import (
    ASSETS_VARIABLE,
    find_assets,
    package_root,
    quiet_import,
)
from lerobot_roborecover.platforms.libero.catalog import (
    libero_tasks,
)
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Pose, Reset, Task
from tests.support.libero_steps import actions, assert_robot_state_equals, clock_of, task_of

pytestmark = pytest.mark.libero


def replay(sim, task: Task, reset: Reset, steps: np.ndarray) -> str:
    sim.reset(task, reset)
    for action in steps:
        sim.step(action)
    return sim.state_sha256()


@pytest.fixture(scope="module")
def sim():
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    simulator = LiberoSimulator(obs_type="state", observation_height=64, observation_width=64)
    yield simulator
    simulator.close()


@pytest.fixture
def offscreen():
    """Makes robosuite's own rendering environments of a task, as the paper's release does."""
    quiet_import(find_assets())
    from libero.libero.envs import OffScreenRenderEnv

    made = []

    def make(task: Task, size: int = 64):
        bddl = package_root() / "bddl_files" / task.suite / f"{task.name}.bddl"
        made.append(OffScreenRenderEnv(bddl_file_name=str(bddl), camera_heights=size, camera_widths=size))
        return made[-1]

    yield make
    for env in made:
        env.close()


def twin_of(env):
    """robosuite's environment inside LIBERO's wrapper, to be read and written as a LiberoTask."""
    from lerobot_roborecover.platforms.libero.task import LiberoTask

    twin = object.__new__(LiberoTask)
    twin.env = env
    return twin


@pytest.mark.nightly
@pytest.mark.render
@pytest.mark.parametrize(("suite", "index", "steps"), [("libero_object", 1, 12), ("libero_spatial", 4, 12)])
def test_reset_steps_and_pictures_equal_a_fresh_robosuite_environment(sim, offscreen, suite, index, steps):
    task, init = task_of(suite, index), 3
    sim.reset(task, Reset(seed=7, init_state_index=init))
    theirs = offscreen(task)
    theirs.seed(7)
    theirs.reset()
    raw = theirs.set_init_state(sim._task.init_states[init])
    twin = twin_of(theirs.env)
    for step, action in enumerate([None, *actions(steps)]):
        if action is not None:
            raw = theirs.step(action)[0]
            sim.step(action)
        assert twin.state_sha256() == sim.state_sha256(), f"after {step} steps"
        assert np.array_equal(clock_of(theirs.env), sim._clock.state)
        state = sim.observe()["robot_state"]
        assert np.array_equal(state["eef"]["pos"], raw["robot0_eef_pos"])
        assert np.array_equal(state["eef"]["quat"], raw["robot0_eef_quat"])
        assert np.array_equal(state["joints"]["vel"], raw["robot0_joint_vel"])
        assert np.array_equal(sim.render(), raw["agentview_image"][::-1, ::-1])
        assert sim.succeeded() == theirs.check_success()


@pytest.mark.nightly
@pytest.mark.parametrize(("suite", "index"), [("libero_spatial", 4), ("libero_10", 9)])
def test_step_is_bit_identical_to_robosuites(sim, suite, index):
    quiet_import(find_assets())
    from libero.libero.envs.env_wrapper import ControlEnv

    task = task_of(suite, index)
    sim.reset(task, Reset(seed=7, init_state_index=0))
    theirs = ControlEnv(
        bddl_file_name=str(package_root() / "bddl_files" / suite / f"{task.name}.bddl"),
        use_camera_obs=False,
        has_offscreen_renderer=False,
        hard_reset=False,
    )
    theirs.env.reset()
    twin = twin_of(theirs.env)
    twin.restore(sim.snapshot())
    contacts = 0
    for action in actions(60):
        theirs.step(action)
        sim.step(action)
        contacts = max(contacts, twin.data.ncon)
        assert twin.state_sha256() == sim.state_sha256()
    assert contacts > 0
    theirs.close()


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.render
def test_observation_equals_lerobots_at_the_same_state():
    quiet_import(find_assets())
    import torch
    from lerobot.envs.libero import LiberoEnv, _get_suite

    from lerobot_roborecover.platforms.libero.init_states import read_init_states
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    suite = _get_suite("libero_spatial")
    theirs = LiberoEnv(
        suite, 1, "libero_spatial", observation_width=128, observation_height=128, obs_type="pixels_agent_pos"
    )
    task = task_of("libero_spatial", libero_tasks()["libero_spatial"].index(theirs.task))
    assert task.instruction == theirs.task_description
    ours = LiberoSimulator(observation_height=128, observation_width=128)
    assert ours.observation_space == theirs.observation_space
    path = package_root() / "init_files" / task.suite / f"{task.name}.pruned_init"
    assert np.array_equal(read_init_states(task.suite, task.name), torch.load(path, weights_only=False))

    theirs.reset(seed=5)
    ours.reset(task, Reset(seed=7, init_state_index=0))
    inner = theirs._env.env
    ours.restore(twin_of(inner).snapshot(clock=clock_of(inner)))
    for action in actions(6).astype(np.float32):
        expected, *_ = theirs.step(action)
        ours.step(action)
        observation = ours.observe()
        assert sorted(observation) == sorted(expected)
        assert_robot_state_equals(observation["robot_state"], expected["robot_state"])
        assert list(observation["pixels"]) == list(expected["pixels"])
        for key, image in expected["pixels"].items():
            assert observation["pixels"][key].dtype == image.dtype
            assert np.array_equal(observation["pixels"][key], image), key
    assert np.array_equal(ours.render(), theirs.render())
    theirs.close()
    ours.close()


FRESH = """
import sys
import numpy as np
from lerobot_roborecover.platforms import make_simulator
sys.path.insert(0, {root!r})
from tests.platforms.test_libero_simulator import actions, replay, task_of
from lerobot_roborecover.scenario import Pose, Reset
sim = make_simulator("libero", obs_type="state")
print(replay(sim, task_of("libero_10", 8), {reset!r}, actions()))
assert "torch" not in sys.modules and "lerobot" not in sys.modules
sim.close()
"""


@pytest.mark.nightly
def test_reset_is_exact_whatever_came_before(sim, tmp_path):
    task = task_of("libero_10", 8)
    first = Reset(seed=7, init_state_index=2)
    expected = replay(sim, task, first, actions())
    fixtures = dict(sim.fixtures())
    assert fixtures
    recorded = Reset(seed=7, init_state_index=2, fixtures=fixtures)
    assert replay(sim, task, recorded, actions()) == expected  # soft reset
    assert replay(sim, task, first, actions()) == expected  # soft reset, the seed's own draw
    other = replay(sim, task, Reset(seed=8, init_state_index=2), actions())  # compiled anew
    assert other != expected
    assert any(pose != fixtures[name] for name, pose in sim.fixtures().items())
    for suite, index in (("libero_spatial", 3), ("libero_10", 9)):  # pushes the task out
        replay(sim, task_of(suite, index), Reset(seed=11, init_state_index=1), actions(5))
    np.random.seed(1234)
    assert replay(sim, task, recorded, actions()) == expected  # compiled anew, recorded poses
    assert np.random.randint(2**31) == np.random.RandomState(1234).randint(2**31)  # others' draws are theirs

    # A fresh process, with no configuration of LIBERO's anywhere and nothing on standard input.
    env = {k: v for k, v in os.environ.items() if k != "LIBERO_CONFIG_PATH"}
    env |= {"HOME": str(tmp_path), ASSETS_VARIABLE: str(find_assets())}
    code = FRESH.format(root=str(Path(__file__).parents[2]), reset=recorded)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == expected


@pytest.mark.parametrize("at", [*(pytest.param(n, marks=pytest.mark.nightly) for n in (0, 1)), 25])
def test_snapshot_continues_like_a_replay(sim, at):
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    task, reset, steps = task_of("libero_spatial", 4), Reset(seed=7, init_state_index=5), actions()
    sim.reset(task, reset)
    for action in steps[:at]:
        sim.step(action)
    snapshot = sim.snapshot()
    for action in steps[at:]:
        sim.step(action)
    expected, bodies, observation = sim.state_sha256(), sim.bodies(), sim.observe()["robot_state"]
    fresh = LiberoSimulator(obs_type="state")
    fresh.reset(task, reset)
    for simulator in (sim, fresh):  # in the middle of an episode, and in another simulator
        simulator.restore(snapshot)
        for action in steps[at:]:
            simulator.step(action)
        assert simulator.state_sha256() == expected
        assert simulator.bodies() == bodies
        assert_robot_state_equals(simulator.observe()["robot_state"], observation)
    fresh.close()


@pytest.mark.nightly
def test_snapshot_of_another_task_is_refused(sim):
    sim.reset(task_of("libero_spatial", 4), Reset(seed=7, init_state_index=0))
    snapshot = sim.snapshot()
    sim.reset(task_of("libero_goal", 3), Reset(seed=7, init_state_index=0))
    with pytest.raises(SimulatorError, match="another task"):
        sim.restore(snapshot)
    with pytest.raises(SimulatorError, match="cannot be read"):
        sim.restore(b"not a snapshot")


@pytest.mark.nightly
@pytest.mark.render
def test_rendering_does_not_touch_the_physics(sim):
    task, reset = task_of("libero_goal", 3), Reset(seed=7, init_state_index=1)
    expected = replay(sim, task, reset, actions(20))
    sim.reset(task, reset)
    pictures = []
    for action in actions(20):
        sim.step(action)
        pictures.append(sim.render())
    assert sim.state_sha256() == expected
    assert pictures[-1].shape == (64, 64, 3)
    assert not np.array_equal(pictures[0], pictures[-1])
    assert np.array_equal(sim.render(), pictures[-1])


@pytest.mark.nightly
@pytest.mark.render
def test_fast_pictures_show_the_same_scene_and_leave_physics_and_full_pictures_alone(
    sim, tmp_path, monkeypatch
):
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    task, reset = task_of("libero_goal", 5), Reset(seed=7, init_state_index=1)
    expected = replay(sim, task, reset, actions(10))
    full = sim.render()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    quick = LiberoSimulator(
        obs_type="pixels", observation_height=64, observation_width=64, render_quality="fast"
    )
    quick.reset(task, reset)
    untouched = quick._task.model.mesh_vert.copy(), quick._task.model.mesh_facenum.copy()
    for action in actions(10):
        quick.step(action)
        pictures = quick.observe()["pixels"]
    assert quick.state_sha256() == expected
    assert (quick._task.model.mesh_vert == untouched[0]).all(), "what collides is not what is thinned"
    assert (quick._task.model.mesh_facenum == untouched[1]).all()
    drawn = quick._view._renderer.model
    assert drawn.mesh_facenum.sum() < 0.25 * untouched[1].sum()
    cached = len(list((tmp_path / "roborecover" / "meshes").glob("*.npz")))
    assert cached > 20
    gap = np.abs(full.astype(int) - pictures["image"][::-1, ::-1])
    assert 0 < gap.mean() < 12, "other pictures, of the same scene"
    quick._view.close()
    again = quick.observe()["pixels"]
    assert all(np.array_equal(again[key], pictures[key]) for key in pictures), "from the cache"
    quick.close()
    assert np.array_equal(sim.render(), full)
    with pytest.raises(SimulatorError, match="'best' is not one of full, fast"):
        LiberoSimulator(render_quality="best")


@pytest.mark.nightly
@pytest.mark.slow
def test_robosuites_horizon_scores_no_success(sim):
    """robosuite ends an episode after 1,000 steps; prefix and budget together may take more."""
    sim.reset(task_of("libero_10", 2), Reset(seed=7, init_state_index=0))
    stay = np.array([0, 0, 0, 0, 0, 0, -1.0])
    for _ in range(1010):
        sim.step(stay)
    assert sim._task.data.time > 1000 / 20
    assert not sim.succeeded()


@pytest.mark.nightly
def test_control_modes(sim):
    task, reset = task_of("libero_goal", 3), Reset(seed=7, init_state_index=0)
    sim.reset(task, reset)
    start = np.array(sim.bodies()["eef"].position_m)
    from scipy.spatial.transform import Rotation

    rotvec = Rotation.from_matrix(sim.observe()["robot_state"]["eef"]["mat"]).as_rotvec()
    goal = start + np.array([0.0, 0.05, -0.05])
    sim.set_control_mode("absolute")
    for _ in range(40):
        sim.step(np.array([*goal, *rotvec, -1.0]))
    assert np.linalg.norm(np.array(sim.bodies()["eef"].position_m) - goal) < 0.01
    sim.reset(task, reset)  # relative again: the same numbers are now a displacement
    for _ in range(10):
        sim.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]))
    assert sim.bodies()["eef"].position_m[2] > start[2] + 0.05
    with pytest.raises(SimulatorError, match="control_mode 'joint'"):
        sim.set_control_mode("joint")


def test_bodies_name_what_can_move(sim):
    sim.reset(task_of("libero_goal", 3), Reset(seed=7, init_state_index=0))
    bodies = sim.bodies()
    assert {"eef", "akita_black_bowl_1_main", "wooden_cabinet_1_cabinet_top"} <= set(bodies)
    assert not any(name.startswith(("robot", "gripper", "mount")) for name in bodies)
    assert set(sim.fixtures()) == {"flat_stove_1_main", "wine_rack_1_main", "wooden_cabinet_1_main"}


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        (Reset(seed=7), "init_state_index"),
        (Reset(init_state_index=0), "a seed or the fixtures"),
        (Reset(seed=7, init_state_index=50), "init states 0 to 49"),
        (Reset(seed=7, init_state_index=0, fixtures={"sofa": Pose((0, 0, 0), (0, 0, 0, 1))}), "sofa"),
    ],
)
def test_unusable_resets_are_refused(sim, reset, message):
    with pytest.raises(SimulatorError, match=message):
        sim.reset(task_of("libero_goal", 3), reset)


def test_unusable_options_and_actions_are_refused(sim):
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    for options, message in (
        ({"obs_type": "depth"}, "obs_type 'depth'"),
        ({"control_mode": "joint"}, "control_mode 'joint'"),
        ({"camera_name": "sideview_image"}, "sideview_image"),
        ({"fps": 0}, "at least 1"),
    ):
        with pytest.raises(SimulatorError, match=message):
            LiberoSimulator(**options)
    with pytest.raises(SimulatorError, match="not reset"):
        LiberoSimulator().succeeded()
    sim.reset(task_of("libero_goal", 3), Reset(seed=7, init_state_index=0))
    with pytest.raises(SimulatorError, match=r"shape \(7,\), got \(4,\)"):
        sim.step(np.zeros(4))
