"""The door for notebooks: `gymnasium.make`."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.workers.recovery_env import HandoffError
from tests.support.factories import fake_scenario


def checked(env: gym.Env) -> None:
    try:
        check_env(env.unwrapped, skip_render_check=True)
    finally:
        env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_fake_passes_gymnasiums_checker():
    checked(gym.make("roborecover/Fake-v0", scenario=fake_scenario(0)))


@pytest.mark.metaworld
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_metaworld_passes_gymnasiums_checker():
    scenario = load_scenarios("metaworld_starter")[0]
    checked(gym.make("roborecover/Metaworld-v0", scenario=scenario, obs_type="state"))


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_libero_passes_gymnasiums_checker():
    scenario = load_scenarios("libero_starter")[0]
    checked(gym.make("roborecover/Libero-v0", scenario=scenario, obs_type="state"))


def test_reset_reports_the_handoff_and_step_the_predicate():
    env = gym.make("roborecover/Fake-v0", scenario=fake_scenario(0))
    observation, info = env.reset()
    assert info["handoff"]["identical"] is True
    assert observation in env.observation_space
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, False, False)


def test_the_budget_is_the_tasks_own():
    scenario = fake_scenario(0, horizon=3)
    env = gym.make("roborecover/Fake-v0", scenario=scenario)
    env.reset()
    ends = [env.step(np.zeros(2, np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True]


def test_a_wrong_platform_or_no_scenario_is_said_so():
    with pytest.raises(ValueError, match="platform 'fake', not 'libero'"):
        gym.make("roborecover/Libero-v0", scenario=fake_scenario(0))
    with pytest.raises(ValueError, match="load_scenarios"):
        gym.make("roborecover/Metaworld-v0")


def test_an_unfaithful_handoff_cannot_be_stepped():
    from dataclasses import replace

    from lerobot_roborecover.scenario import Pose

    scenario = fake_scenario(0)
    bodies = dict(scenario.fingerprint.bodies) | {"eef": Pose((9.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    env = gym.make(
        "roborecover/Fake-v0",
        scenario=replace(scenario, fingerprint=replace(scenario.fingerprint, bodies=bodies)),
    )
    _, info = env.reset()
    assert info["handoff"]["problem"] == "state_mismatch"
    with pytest.raises(HandoffError, match="eef is"):
        env.step(np.zeros(2, np.float32))
