"""LIBERO's `observation.environment_state`: that the numbers are what they are said to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.platforms.libero.catalog import GOAL_KINDS, workable_order
from lerobot_roborecover.platforms.libero.goal_state import ENVIRONMENT_STATE, ENVIRONMENT_STATE_DIM
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.scenario import Task

pytestmark = pytest.mark.libero


@pytest.fixture(scope="module")
def sim():
    from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator

    simulator = LiberoSimulator(obs_type="state")
    yield simulator
    simulator.close()


def task_of(suite: str, words: str) -> Task:
    return next(t for t in PLATFORM.tasks() if t.suite == suite and words in t.name)


def start(sim, task: Task) -> dict[str, np.ndarray]:
    sim.reset(task, PLATFORM.first_reset(task))
    sim.step(PLATFORM.no_op())
    return read(sim)


def read(sim) -> dict[str, np.ndarray]:
    """The numbers by the names before their colons and commas' explanations."""
    values, found = sim.observe()["environment_state"], {}
    assert values.shape == (ENVIRONMENT_STATE_DIM,)
    assert values.dtype == np.float64
    assert np.isfinite(values).all()
    for name, width in ENVIRONMENT_STATE:
        found[name.split(":")[0]], values = values[:width], values[width:]
    return found


def kind(numbers: np.ndarray) -> str:
    return GOAL_KINDS[int(numbers.argmax())]


def test_what_is_closed_is_closed_last():
    goals = [["close", "drawer"], ["in", "bowl", "drawer"], ["on", "cup", "plate"]]
    assert workable_order(goals) == [
        ("in", "bowl", "drawer"),
        ("on", "cup", "plate"),
        ("close", "drawer"),
    ]


@pytest.mark.nightly
def test_a_bowl_on_its_way_to_a_plate(sim):
    from lerobot_roborecover.platforms.libero.expert import LiberoExpert
    from lerobot_roborecover.platforms.libero.scene import LiberoScene

    task = task_of("libero_spatial", "table_center")
    first = start(sim, task)
    bowl = np.array(sim.bodies()["akita_black_bowl_1_main"].position_m)
    hand = np.array(sim.bodies()["eef"].position_m)
    assert kind(first["goal.kind"]) == "on"
    assert np.allclose(first["item.centre, from the hand"][:2], (bowl - hand)[:2], atol=0.005)
    assert np.allclose(
        first["item.centre, from base"] - first["item.centre, from the hand"],
        first["hand.position, from base"],
    )
    assert np.allclose(
        first["place.centre, from base"] - first["item.centre, from base"],
        first["place.centre, from the item"],
    )
    assert 0.03 < first["item.half extents along the axes"][0] < 0.08
    assert first["item.held"] == first["part.flag"] == first["next.flag"] == 0
    assert not first["part.direction in which the handle opens it, a unit vector"].any()
    assert first["neighbour 1.flag"] == first["neighbour 2.flag"] == 1
    expert, held = LiberoExpert(LiberoScene(sim)), False
    for _ in range(task.horizon):
        sim.step(expert.act())
        now = read(sim)
        held |= bool(now["item.held"])
        if sim.succeeded():
            break
    assert held
    assert sim.succeeded()
    assert now["goals that are not reached"] == 0
    assert np.linalg.norm(now["place.centre, from the item"][:2]) < 0.03
    assert now["hand.opening of the two fingers together"] > 0.01


@pytest.mark.parametrize(
    ("suite", "words", "kinds", "opening", "away"),
    [
        pytest.param(
            "libero_goal", "open_the_middle_drawer", ["open"], 0, [0, 1, 0], marks=pytest.mark.nightly
        ),
        pytest.param("libero_10", "bottom_drawer", ["in", "close"], 1, [0, -1, 0], marks=pytest.mark.nightly),
        pytest.param("libero_10", "microwave", ["in", "close"], 1, None, marks=pytest.mark.nightly),
        pytest.param("libero_goal", "turn_on_the_stove", ["turnon"], 0, None, marks=pytest.mark.nightly),
    ],
)
def test_parts_on_joints(sim, suite, words, kinds, opening, away):
    first = start(sim, task_of(suite, words))
    assert kind(first["goal.kind"]) == kinds[0]
    assert first["next.flag"] == len(kinds) - 1
    assert first["place.flag"] == (kinds[0] in ("on", "in"))
    assert first["part.flag"] == 1
    assert abs(first["part.opening"][0] - opening) < 0.1
    direction = first["part.direction in which the handle opens it, a unit vector"]
    assert np.isclose(np.linalg.norm(direction), 1)
    if away:
        assert direction @ away > 0.95  # cabinets are turned a little
    assert first["goals that are not reached"] == len(kinds)


def test_numbers_are_the_same_after_a_replay_and_a_snapshot(sim):
    task = task_of("libero_spatial", "table_center")
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 7))

    def replay() -> list[np.ndarray]:
        start(sim, task)
        seen = []
        for n, action in enumerate(actions):
            if n == 4:
                sim.restore(sim.snapshot())
            sim.step(action)
            seen.append(sim.observe()["environment_state"])
        return seen

    assert all(np.array_equal(a, b) for a, b in zip(replay(), replay(), strict=True))


@pytest.mark.lerobot
def test_lerobot_is_told():
    from lerobot.envs.utils import env_to_policy_features

    from lerobot_roborecover.platforms.libero.env_config import LiberoConfig

    features = env_to_policy_features(LiberoConfig(obs_type="state"))
    assert features["observation.environment_state"].shape == (ENVIRONMENT_STATE_DIM,)
    assert "observation.environment_state" not in env_to_policy_features(LiberoConfig())


@pytest.mark.lerobot
@pytest.mark.parametrize("obs_type", ["state", "pixels_agent_pos", "pixels"])
def test_lerobot_is_told_what_its_processor_gives(obs_type):
    import torch
    from lerobot.envs.utils import env_to_policy_features, preprocess_observation

    from lerobot_roborecover.platforms.libero.env_config import LiberoConfig

    config = LiberoConfig(obs_type=obs_type)
    raw = {}
    if obs_type != "pixels":
        sizes = {"eef": {"pos": (3,), "quat": (4,), "mat": (3, 3)}, "gripper": {"qpos": (2,), "qvel": (2,)}}
        sizes["joints"] = {"pos": (7,), "vel": (7,)}
        raw["robot_state"] = {k: {n: np.ones((1, *s)) for n, s in of.items()} for k, of in sizes.items()}
    if obs_type == "state":
        raw["environment_state"] = np.zeros((1, ENVIRONMENT_STATE_DIM))
    else:
        picture = np.zeros((1, config.observation_height, config.observation_width, 3), np.uint8)
        raw["pixels"] = {"image": picture, "image2": picture}
    before, _ = config.get_env_processors()
    given = before(preprocess_observation(raw))
    told = {k: f.shape for k, f in env_to_policy_features(config).items() if k != "action"}
    assert told == {k: tuple(v.shape[1:]) for k, v in given.items() if isinstance(v, torch.Tensor)}


def test_the_page_has_the_table():
    page = (Path(__file__).parents[2] / "docs" / "log" / "libero_state.md").read_text()
    rows = [line.strip("| ").split(" | ", 1) for line in page.splitlines() if line.startswith("| ")][1:]
    assert [name for _, name in rows] == [name for name, _ in ENVIRONMENT_STATE]
    ends = np.cumsum([width for _, width in ENVIRONMENT_STATE])
    assert [int(numbers.split("-")[-1]) for numbers, _ in rows] == [end - 1 for end in ends]


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--render_quality=fast"], True),
        ([], False),
        (["--render_quality=fast", "--obs_type=state"], False),
    ],
)
def test_trials_say_which_fast_pictures_they_saw(options, said):
    from lerobot_roborecover.curation.policy_trials import env_config

    decisive = env_config("libero", "none", options).run_spec().decisive
    assert ("fast_pictures" in decisive) == said


@pytest.mark.nightly
@pytest.mark.slow
def test_progress_is_the_share_of_goals_that_hold(sim):
    """Two objects into one place, one after the other: none, half, all, and all exactly on success."""
    task = task_of("libero_10", "both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket")
    sim.reset(task, PLATFORM.first_reset(task))
    for _ in range(10):
        sim.step(PLATFORM.no_op())
    act = PLATFORM.experts["scripted"].make(sim, task, np.random.default_rng(0))
    seen = [sim.progress()]
    while not sim.succeeded() and len(seen) < 800:
        sim.step(act(len(seen) - 1))
        seen.append(sim.progress())
        assert (seen[-1] == 1.0) == sim.succeeded()
    assert list(dict.fromkeys(seen)) == [0.0, 0.5, 1.0]
