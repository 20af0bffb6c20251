"""The Meta-World simulator: exact resets, replays and snapshots, and LeRobot's own observations."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from lerobot_roborecover.platforms import SimulatorError, make_simulator
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off, with_fingerprint
from lerobot_roborecover.scenario import Reset, Scenario, Task

pytestmark = pytest.mark.metaworld

CONTACT_TASKS = ("push-v3", "hammer-v3", "stick-push-v3", "door-open-v3", "bin-picking-v3", "plate-slide-v3")
"""Six ways of touching things; a test that runs each takes two of them but for the nightly run."""
EACH_TASK = [
    *CONTACT_TASKS[:2],
    *(pytest.param(name, marks=pytest.mark.nightly) for name in CONTACT_TASKS[2:]),
]


def task(name: str) -> Task:
    return Task("metaworld", "easy", name, "do it", 500)


def downward_actions(steps: int, seed: int = 0) -> np.ndarray:
    """Random actions that press on the table, so that objects and the hand touch things."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (steps, 4)) + np.array([0.0, 0.15, -0.25, 0.0])


def trajectory(simulator, name: str, seed: int, actions: np.ndarray) -> list[str]:
    """State hashes after the reset and after each action."""
    simulator.reset(task(name), Reset(seed=seed))
    hashes = [simulator.state_sha256()]
    for action in actions:
        simulator.step(action)
        hashes.append(simulator.state_sha256())
    return hashes


def state_simulator():
    return make_simulator("metaworld", obs_type="state")


@pytest.fixture(scope="module")
def simulator():
    made = state_simulator()
    yield made
    made.close()


@pytest.mark.nightly
@pytest.mark.parametrize("name", EACH_TASK)
def test_same_seed_same_states_whatever_came_before(simulator, name):
    actions = downward_actions(60)
    first = trajectory(simulator, name, 3, actions)
    trajectory(simulator, name, 4, downward_actions(40, seed=1))
    for other in CONTACT_TASKS:
        simulator.reset(task(other), Reset(seed=8))
    assert trajectory(simulator, name, 3, actions) == first
    assert trajectory(state_simulator(), name, 3, actions) == first
    assert trajectory(simulator, name, 4, actions)[0] != first[0]


def test_same_seed_same_states_in_a_fresh_process(simulator):
    program = (
        "import sys, json, numpy as np\n"
        "from lerobot_roborecover.platforms import make_simulator\n"
        "from lerobot_roborecover.scenario import Reset, Task\n"
        "s = make_simulator('metaworld', obs_type='state')\n"
        "s.reset(Task('metaworld', 'easy', 'hammer-v3', 'do it', 500), Reset(seed=3))\n"
        "[s.step(np.array(a)) for a in json.load(sys.stdin)]\n"
        "print(s.state_sha256(), 'lerobot' in sys.modules, 'torch' in sys.modules)\n"
    )
    actions = downward_actions(60)
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(actions.tolist()),
        capture_output=True,
        text=True,
        check=True,
    )
    expected = trajectory(simulator, "hammer-v3", 3, actions)[-1]
    assert done.stdout.split() == [expected, "False", "False"]


@pytest.mark.parametrize("name", EACH_TASK)
def test_snapshot_continues_like_the_replay(simulator, name):
    actions = downward_actions(80)
    trajectory(simulator, name, 3, actions[:50])
    snapshot = simulator.snapshot()
    before = simulator.low_dim(), simulator.bodies(), simulator.succeeded()
    expected = []
    for action in actions[50:]:
        simulator.step(action)
        expected.append((simulator.state_sha256(), simulator.observe(), simulator.succeeded()))

    other = state_simulator()
    other.reset(task(name), Reset(seed=3))
    other.restore(snapshot)
    assert np.array_equal(other.low_dim(), before[0])
    assert (other.bodies(), other.succeeded()) == before[1:]
    for action, (state, observation, succeeded) in zip(actions[50:], expected, strict=True):
        other.step(action)
        assert other.state_sha256() == state
        assert all(np.array_equal(other.observe()[key], value) for key, value in observation.items())
        assert other.succeeded() is succeeded


@pytest.mark.nightly
def test_step_assigns_no_attribute_that_a_snapshot_lacks(simulator):
    """Guards `STEP_ATTRIBUTES` against a task that starts to keep state in Python."""
    from lerobot_roborecover.platforms.metaworld.scene import STEP_ATTRIBUTES
    from lerobot_roborecover.platforms.metaworld.simulator import metaworld

    covered = {*STEP_ATTRIBUTES, "curr_path_length", "_prev_obs", "_last_stable_obs"}
    views = {"init_left_pad", "init_right_pad"}  # MuJoCo's own body positions, seen through an attribute
    for name in metaworld.ALL_V3_ENVIRONMENTS:
        simulator.reset(task(name), Reset(seed=1))
        held = simulator._env.__dict__
        kinds = (int, float, np.ndarray, np.generic, type(None))
        before = {k: np.array(v) for k, v in held.items() if isinstance(v, kinds)}
        for action in downward_actions(3):
            simulator.step(action)
        changed = {k for k, v in held.items() if k not in before or _differs(before[k], v)}
        changed -= {k for k in changed if k not in before and not isinstance(held[k], kinds)}
        assert changed - views <= covered, name


def _differs(before: np.ndarray, now: object) -> bool:
    return before.tobytes() != np.array(now).tobytes() if before.dtype != object else now is not before.item()


def test_bodies_names_what_moves_and_sees_a_hinge_turn(simulator):
    simulator.reset(task("door-open-v3"), Reset(seed=3))
    closed = simulator.bodies()
    env = simulator._env
    env.data.joint("doorjoint").qpos[:] = -0.5
    simulator.step(np.zeros(4))
    assert set(closed) == {"eef", "door_link", "door_link.handle", "goal"}
    assert simulator.bodies()["door_link"].distance_m(closed["door_link"]) > 0.05
    for name, moving in (("hammer-v3", {"hammerbody", "nail_link"}), ("stick-push-v3", {"stick", "object"})):
        simulator.reset(task(name), Reset(seed=3))
        assert {n for n in simulator.bodies() if "." not in n} - {"eef", "goal"} == moving


LATE = (
    "coffee-pull-v3", "coffee-push-v3", "dial-turn-v3", "drawer-open-v3", "faucet-open-v3", "lever-pull-v3",
    "window-close-v3", "window-open-v3",
)  # fmt: skip
"""Where Meta-World's own reset leaves something that hangs on a fixture behind."""


@pytest.mark.parametrize("name", [*LATE, "push-v3", "peg-insert-side-v3"])
def test_what_hangs_on_a_fixture_is_there_before_the_first_step(simulator, name):
    """Else the first step seems to move it, by up to 220 mm, and labels call it knocked aside."""
    for seed in (3, 4):
        simulator.reset(task(name), Reset(seed=seed))
        state, first = simulator.state_sha256(), simulator.bodies()
        assert simulator.state_sha256() == state
        simulator.restore(simulator.snapshot())
        for body, pose in simulator.bodies().items():
            assert pose.distance_m(first[body]) < 0.001, f"{body}: more than a physics step's motion"
        simulator.reset(task(name), Reset(seed=seed))
        simulator.step(np.zeros(4))
        for body, pose in simulator.bodies().items():
            assert pose.distance_m(first[body]) < 0.02, f"{body}: more than settling"


def test_marks_are_the_handled_point_and_where_it_belongs(simulator):
    from lerobot_roborecover.platforms.metaworld.experts import expert

    for name, body in (
        ("basketball-v3", "bsktball"),
        ("coffee-button-v3", "cmbutton"),
        ("hammer-v3", "hammerbody"),
    ):
        simulator.reset(task(name), Reset(seed=3))
        act, reached = expert(simulator, name), []
        for t in range(150):
            simulator.step(act(t))
            found = simulator.bodies()
            reached.append(found["eef"].distance_m(found[f"{body}.handle"]))
            if simulator.succeeded():
                break
        assert min(reached) < 0.13, name
        assert found[f"{body}.handle"].distance_m(found["goal"]) < 0.1, name


def test_steps_beyond_500_neither_raise_nor_reset(simulator):
    simulator.reset(task("reach-v3"), Reset(seed=3))
    hidden = simulator.bodies()["obj"]
    for _ in range(520):
        simulator.step(np.array([0.0, 0.0, 1.0, 0.0]))
    assert simulator.bodies()["eef"].position_m[2] > 0.25  # a reset would have lowered the hand again
    assert simulator.bodies()["obj"].distance_m(hidden) < 1e-3


def test_success_is_the_last_steps_and_false_after_a_reset(simulator):
    from lerobot_roborecover.platforms.metaworld.experts import expert

    simulator.reset(task("reach-v3"), Reset(seed=3))
    act = expert(simulator, "reach-v3")
    steps = 0
    while not simulator.succeeded() and steps < 100:
        simulator.step(act(steps))
        steps += 1
    assert 5 < steps < 100
    simulator.step(np.array([0.0, -1.0, 1.0, 0.0]))
    for _ in range(30):
        simulator.step(np.array([0.0, -1.0, 1.0, 0.0]))
    assert not simulator.succeeded()
    while not simulator.succeeded():
        simulator.step(act(0))
    simulator.reset(task("reach-v3"), Reset(seed=3))
    assert simulator.succeeded() is False


def test_state_observation_shows_the_goal_and_fits_its_space(simulator):
    simulator.reset(task("pick-place-v3"), Reset(seed=3))
    observation = simulator.observe()
    assert simulator.observation_space.contains(observation)
    assert {k: v.shape for k, v in observation.items()} == {"agent_pos": (4,), "environment_state": (39,)}
    assert np.array_equal(observation["environment_state"][-3:], simulator._env._target_pos)
    simulator.step(np.ones(4))
    assert np.array_equal(simulator.observe()["environment_state"][-3:], simulator._env._target_pos)


def test_hand_off_by_replay_and_by_snapshot_is_identical(simulator):
    bare = Scenario(
        id="s", task=task("push-v3"), reset=Reset(seed=5), prefix=downward_actions(70),
        stage="Approach", deviation="Wrong Pose", source="perturbed",
    )  # fmt: skip
    scenario = with_fingerprint(simulator, bare)
    cache = SnapshotCache()
    replayed, restored = (hand_off(state_simulator(), scenario, cache=cache) for _ in range(2))
    assert (replayed.from_snapshot, restored.from_snapshot) == (False, True)
    for handoff in (replayed, restored):
        assert handoff.problem is None
        assert handoff.identical
        assert handoff.eef_error_mm == handoff.object_error_mm == 0.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.reset(task("push-v3"), Reset()), "reset must name one"),
        (lambda s: s.reset(task("juggle-v3"), Reset(seed=1)), "has no task 'juggle-v3'"),
        (lambda s: s.step(np.zeros(7)), "4 finite numbers"),
        (lambda s: s.step(np.array([0.0, np.nan, 0.0, 0.0])), "4 finite numbers"),
        (lambda s: s.restore(b"nonsense"), "cannot be read"),
        (lambda s: make_simulator("metaworld", obs_type="smell"), "obs_type 'smell'"),
        (lambda s: state_simulator().observe(), "call reset first"),
    ],
)
def test_refusals_say_what_and_why(simulator, call, message):
    simulator.reset(task("reach-v3"), Reset(seed=1))
    with pytest.raises(SimulatorError, match=message):
        call(simulator)


def test_a_snapshot_of_another_task_is_refused(simulator):
    simulator.reset(task("hammer-v3"), Reset(seed=1))
    snapshot = simulator.snapshot()
    simulator.reset(task("reach-v3"), Reset(seed=1))
    with pytest.raises(SimulatorError, match="another task"):
        simulator.restore(snapshot)


@pytest.mark.nightly
@pytest.mark.render
def test_rendering_leaves_the_states_alone(simulator):
    actions = downward_actions(12)
    blind = trajectory(simulator, "hammer-v3", 3, actions)
    seeing = make_simulator("metaworld", observation_height=96, observation_width=128)
    try:
        seeing.reset(task("hammer-v3"), Reset(seed=3))
        frames = [seeing.observe()["pixels"]]
        for action, state in zip(actions, blind[1:], strict=True):
            seeing.step(action)
            frames.append(seeing.observe()["pixels"])
            assert seeing.state_sha256() == state
        assert frames[0].shape == (96, 128, 3)
        assert not np.array_equal(frames[0], frames[-1])
    finally:
        seeing.close()


@pytest.mark.nightly
@pytest.mark.render
def test_frames_do_not_mix_between_tasks():
    """Each task has its own OpenGL context; Gymnasium alone would draw the second task in the first one's."""
    seeing = make_simulator("metaworld", observation_height=96, observation_width=96)
    try:
        frames = {}
        for name, seed in (
            ("push-v3", 3),
            ("door-open-v3", 3),
            ("push-v3", 4),
            ("push-v3", 3),
            ("door-open-v3", 3),
        ):
            seeing.reset(task(name), Reset(seed=seed))
            frame = seeing.render()
            assert np.array_equal(frames.setdefault((name, seed), frame), frame)
            for action in downward_actions(5, seed):
                seeing.step(action)
        assert len({frame.tobytes() for frame in frames.values()}) == 3
    finally:
        seeing.close()


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.render
@pytest.mark.slow
def test_observations_equal_lerobots_bit_for_bit():
    from lerobot.envs.metaworld import MetaworldEnv

    ours = make_simulator("metaworld", obs_type="pixels_agent_pos")
    pixels_only = make_simulator("metaworld", obs_type="pixels")
    theirs = MetaworldEnv(task="push-v3", obs_type="pixels_agent_pos")
    try:
        observation, _ = theirs.reset(seed=5)
        ours.reset(task("push-v3"), Reset(seed=5))
        pixels_only.reset(task("push-v3"), Reset(seed=5))
        assert ours.observation_space == theirs.observation_space
        assert (
            pixels_only.observation_space == MetaworldEnv(task="push-v3", obs_type="pixels").observation_space
        )
        for action in [None, *downward_actions(5).astype(np.float32)]:
            if action is not None:
                observation, *_ = theirs.step(action)
                ours.step(action)
                pixels_only.step(action)
            mine = ours.observe()
            assert mine.keys() == observation.keys()
            for key, value in observation.items():
                assert mine[key].dtype == value.dtype
                if key == "pixels" and action is None:
                    # LeRobot's first frame shows the goal marker as its previous reset left it, 0.01 mm off.
                    difference = np.abs(mine[key].astype(int) - value)
                    assert difference.max() <= 1
                    assert (difference > 0).mean() < 1e-4
                else:
                    assert np.array_equal(mine[key], value)
        assert np.array_equal(ours.render(), theirs.render())
        assert pixels_only.observe().keys() == {"pixels"}
        assert np.array_equal(pixels_only.observe()["pixels"], observation["pixels"])
    finally:
        for made in (ours, pixels_only, theirs):
            made.close()


@pytest.mark.lerobot
@pytest.mark.parametrize("name", EACH_TASK)
def test_states_equal_lerobots_without_rendering(name, simulator, monkeypatch):
    """Longer, over several tasks, with the same float32 actions; only LeRobot's rendering is left out."""
    from lerobot.envs.metaworld import MetaworldEnv

    theirs = MetaworldEnv(task=name, obs_type="pixels_agent_pos")
    monkeypatch.setattr(theirs, "_format_raw_obs", lambda raw: raw)
    theirs.reset(seed=5)
    simulator.reset(task(name), Reset(seed=5))
    for action in downward_actions(60).astype(np.float32):
        raw, _, terminated, _, _ = theirs.step(action)
        simulator.step(action)
        assert terminated is simulator.succeeded()
        if terminated:
            break
        assert np.array_equal(raw[:36], simulator.low_dim()[:36])
        assert np.array_equal(theirs._env.data.qpos, simulator._env.data.qpos)
    theirs.close()


def test_progress_is_the_distance_that_is_gone(request):
    """0 after a reset, 1 on success alone; asking changes nothing."""
    from lerobot_roborecover.platforms import make_simulator, platform_named
    from lerobot_roborecover.scenario import Reset

    platform = platform_named("metaworld")
    task = platform.task("reach-v3")
    simulator = make_simulator("metaworld", obs_type="state")
    request.addfinalizer(simulator.close)
    driver = platform.experts["expert"].make
    simulator.reset(task, Reset(seed=1))
    act, seen = driver(simulator, task, np.random.default_rng(0)), [simulator.progress()]
    while not simulator.succeeded() and len(seen) < 200:
        simulator.step(act(len(seen) - 1))
        before = simulator.state_sha256()
        seen.append(simulator.progress())
        assert simulator.state_sha256() == before
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    assert 0.5 < max(seen[:-1]) < 1.0
