"""LeRobot's env types as platforms: PushT and Aloha for real, and environments that misbehave."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
import types
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.platforms.check import CheckRequest, check_platform
from lerobot_roborecover.platforms.lerobot.simulator import LeRobotSimulator
from lerobot_roborecover.platforms.lerobot.source import EnvSource, check_hub
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.scenario import Reset, Task
from tests.support.hub_client import HubClient
from tests.support.hub_server import HubServer, Repo

pytest.importorskip("gym_pusht", reason="pip install 'lerobot_env_roborecover[gym]'")


class Toy(gym.Env):
    """A point that a well-behaved environment moves about; subclasses misbehave."""

    action_space: gym.Space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space: gym.Space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(-1.0, 1.0, (2,), np.float64)})
    at: np.ndarray

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        start = (options or {}).get("start")
        self.at = self.np_random.uniform(-1, 1, 2) if start is None else np.array(start, float)
        return self.seen(), {}

    def step(self, action):
        self.at = self.at + 0.1 * np.asarray(action)
        return self.seen(), 0.0, self.over(), False, self.info()

    def seen(self):
        return {"agent_pos": self.at.copy()}

    def over(self) -> bool:
        return False

    def info(self) -> dict:
        return {"is_success": bool(np.linalg.norm(self.at) > 3.0)}


class Clock(Toy):
    observation_space = gym.spaces.Dict(
        {**Toy.observation_space.spaces, "clock": gym.spaces.Box(0, np.inf, (1,), np.float64)}
    )

    def seen(self):
        return {**super().seen(), "clock": np.array([time.perf_counter()])}


class Unseeded(Toy):
    def reset(self, *, seed=None, options=None):
        seen = super().reset(seed=None, options=options)
        self.at = np.random.default_rng().uniform(-1, 1, 2)
        return self.seen(), seen[1]


class NoSeed(Toy):
    def reset(self):  # ty: ignore[invalid-method-override]
        return super().reset()


class Silent(Toy):
    def info(self) -> dict:
        return {"coverage": 1.0}


class Ends(Toy):
    def over(self) -> bool:
        return bool(self.at[0] > 1.2)


class Discrete(Toy):
    action_space = gym.spaces.Discrete(4)


class Flat(Toy):
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)

    def seen(self):
        return self.at.copy()


class Pair(Toy):
    hidden = 0.0

    def get_state(self):
        return np.array([*self.at, self.hidden])

    def set_state(self, state):
        self.at, self.hidden = np.array(state[:2]), float(state[2])


TOYS = {c.__name__: c for c in (Toy, Clock, Unseeded, NoSeed, Silent, Ends, Discrete, Flat, Pair)}
START = Reset(seed=3)


@pytest.fixture
def toys(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_toy", types.ModuleType("gym_toy"))
    for name, kind in TOYS.items():
        gym.register(f"gym_toy/{name}-v0", entry_point=kind, max_episode_steps=5)
    yield
    for name in TOYS:
        del gym.registry[f"gym_toy/{name}-v0"]


def toy(name: str) -> LeRobotSimulator:
    source = EnvSource(package="gym_toy").as_options()
    return LeRobotSimulator("toy", "lerobot_toy", 10.0, source, f"{name}-v0")


def task_of(name: str) -> Task:
    return Task("lerobot_toy", "toy", f"{name}-v0", "go far", 20)


def test_a_toy_goes_on_after_its_time_limit_and_is_rebuilt(toys):
    simulator = toy("Toy")
    hashes = []
    for _ in range(2):
        simulator.reset(task_of("Toy"), START)
        seen = [simulator.state_sha256()]
        for _ in range(40):
            simulator.step(np.array([1.0, 1.0]))
            seen.append(simulator.state_sha256())
        hashes.append(seen)
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == 41  # the limit of five steps ends nothing
    assert simulator.succeeded()


def test_options_of_a_reset_decide_its_first_state(toys):
    simulator = toy("Toy")
    simulator.reset(task_of("Toy"), Reset(seed=3, options={"start": [0.5, 0.25]}))
    assert simulator.observe()["agent_pos"].tolist() == [0.5, 0.25]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("NoSeed", "seedable reset"),
        ("Flat", "not a dict of agent_pos"),
        ("Discrete", "Discrete\\(4\\)"),
        ("Missing", "registers no task 'Missing-v0'"),
    ],
)
def test_what_cannot_be_rebuilt_is_refused(toys, name, says):
    with pytest.raises(SimulatorError, match=says):
        toy(name).reset(task_of(name), START)


def test_an_environment_without_success_is_refused(toys):
    simulator = toy("Silent")
    simulator.reset(task_of("Silent"), START)
    with pytest.raises(SimulatorError, match=r"holds coverage, and no is_success.*--env\.success_key"):
        simulator.step(np.zeros(2))
    source = EnvSource(package="gym_toy").as_options()
    named = LeRobotSimulator("toy", "lerobot_toy", 10.0, source, "Silent-v0", success_key="coverage")
    named.reset(task_of("Silent"), START)
    named.step(np.zeros(2))
    assert named.succeeded()


def test_an_end_without_success_is_no_success_and_nothing_changes_any_more(toys, caplog):
    simulator = toy("Ends")
    simulator.reset(task_of("Ends"), START)
    with caplog.at_level(logging.WARNING):
        for _ in range(30):
            simulator.step(np.array([1.0, 0.0]))
    assert simulator.ended
    assert not simulator.succeeded()
    assert simulator.observe()["agent_pos"][0] < 1.31
    assert caplog.text.count("ended by itself without success") == 1


def test_an_action_outside_the_space_is_passed_on_and_said_once(toys, caplog):
    simulator = toy("Toy")
    simulator.reset(task_of("Toy"), START)
    before = simulator.observe()["agent_pos"]
    with caplog.at_level(logging.WARNING):
        simulator.step(np.array([5.0, 0.0]))
        simulator.step(np.array([5.0, 0.0]))
    assert simulator.observe()["agent_pos"] == pytest.approx(before + np.array([1.0, 0.0]))
    assert caplog.text.count("is outside Box") == 1


@pytest.mark.parametrize("action", [np.zeros(3), np.array([np.nan, 0.0])])
def test_an_action_that_is_none_is_refused(toys, action):
    simulator = toy("Toy")
    simulator.reset(task_of("Toy"), START)
    with pytest.raises(SimulatorError, match="is 2 finite numbers"):
        simulator.step(action)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "says"), [("Clock", "observation.clock"), ("Unseeded", "agent_pos")])
def test_the_conformance_suite_names_what_differs(toys, monkeypatch, name, says):
    platform = platform_named("lerobot_pusht")  # whichever: its simulator is replaced
    monkeypatch.setattr(platform, "make_simulator", lambda **_: toy(name), raising=False)
    request = CheckRequest("lerobot_pusht", (replace(task_of(name)),), steps=5)
    found = {c.name: c for c in check_platform(request) if c.failed}
    assert f"{name}-v0: replay" in found
    assert says in found[f"{name}-v0: replay"].detail


def test_a_pair_of_get_and_set_is_the_state(toys):
    simulator = toy("Pair")
    simulator.reset(task_of("Pair"), START)
    before = simulator.state_sha256()
    kept = simulator.snapshot()
    simulator.env.unwrapped.hidden = 1.0
    assert simulator.state_sha256() != before
    simulator.restore(kept)
    assert simulator.state_sha256() == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lerobot_pusht", pytest.param("lerobot_aloha", marks=pytest.mark.nightly)])
def test_the_contract_holds(name):
    platform = platform_named(name)
    request = CheckRequest(name, tuple(platform.tasks()), {"obs_type": "state"}, steps=20)
    if name == "lerobot_aloha":
        request = replace(request, tasks=request.tasks[:1])
    checks = list(check_platform(request))
    assert not [c for c in checks if c.failed]
    assert any(c.name == "imports of a worker" and c.status == "ok" for c in checks)


@pytest.mark.lerobot
@pytest.mark.parametrize("obs_type", ["environment_state_agent_pos", "pixels_agent_pos"])
def test_observations_are_lerobots_own(obs_type):
    from lerobot.envs.configs import PushtEnv
    from lerobot.envs.factory import make_env

    from lerobot_roborecover.curation.policy_trials import env_config

    config = env_config("lerobot_pusht", "none", [f"--base.obs_type={obs_type}"])
    ours = make_simulator("lerobot_pusht", **config.run_spec().slot.options)
    theirs = make_env(PushtEnv(obs_type=obs_type))["pusht"][0]
    (task,) = platform_named("lerobot_pusht").tasks()
    ours.reset(task, Reset(seed=11))
    seen, _ = theirs.reset(seed=[11])
    for action in np.random.default_rng(0).uniform(100, 400, (5, 2)):
        for key, value in ours.observe().items():
            np.testing.assert_array_equal(value, seen[key][0])
        ours.step(action)
        seen, *_ = theirs.step(action[None])
    theirs.close()


@pytest.mark.lerobot
def test_the_base_is_chosen_by_its_options():
    from lerobot_roborecover.curation.policy_trials import env_config

    config = env_config("lerobot_aloha", "none", ["--base.task=AlohaTransferCube-v0"])
    spec = config.run_spec()
    assert spec.slot.platform == "lerobot_aloha"
    assert spec.slot.options["task"] == "AlohaTransferCube-v0"
    assert config.features["action"].shape == (14,)
    state = env_config("lerobot_pusht", "none", ["--obs_type=state"])
    assert state.obs_type == "state"
    assert state.features["observation.environment_state".removeprefix("observation.")].shape == (16,)


@pytest.mark.lerobot
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--base.type=hub", "--base.hub_path=lab/env"], "user/name@commit"),
        (["--base.type=hub", f"--base.hub_path=lab/env@{'0' * 40}"], "trust_remote_code"),
        (["--base.type=aloha", "--obs_type=nonsense"], "nothing to see"),
    ],
)
def test_a_base_that_cannot_be_used_is_refused(options, says):
    from lerobot_roborecover.curation.policy_trials import env_config

    with pytest.raises(OptionError, match=says):
        env_config("lerobot", "none", options).run_spec()


@pytest.mark.slow
def test_the_family_stands_for_its_first_member(capsys):
    """`roborecover_wrapped` serves several platforms; as a platform's name, it is PushT."""
    scenario = load_scenarios("pusht_starter")[0]
    for name in ("Lerobot", "Lerobot_pusht"):
        env = gym.make(f"roborecover/{name}-v0", scenario=scenario, obs_type="state")
        assert env.reset()[1]["handoff"]["identical"]
        env.close()
    assert main(["check-platform", "lerobot", "--steps", "5"]) == 0
    assert "0 failures" in capsys.readouterr().out


@pytest.mark.lerobot
def test_a_base_is_known_by_what_a_platforms_name_has_of_it(monkeypatch):
    from lerobot.envs.configs import EnvConfig, PushtEnv

    from lerobot_roborecover.platforms.lerobot.env_config import BaseEnvConfig

    monkeypatch.setitem(EnvConfig._choice_registry, "Push-T.2", PushtEnv)
    assert BaseEnvConfig.get_choice_class("push_t_2") is PushtEnv
    with pytest.raises(KeyError):
        BaseEnvConfig.get_choice_class("push_t_3")


def test_a_moving_branch_of_the_hub_is_refused():
    with pytest.raises(SimulatorError, match="40 hex digits"):
        check_hub("lab/env@main")


@pytest.mark.lerobot
@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ["pusht", "aloha"])
def test_the_whole_chain(name, tmp_path):
    program = [sys.executable, "-m", "tests.support.outside_chain", str(tmp_path), name]
    done = subprocess.run(program, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["candidates"] == 4
    assert found["lerobot_eval"] == found["roborecover_eval"]  # the same outcomes, to the step
    assert (len(found["lerobot_eval"]), len(found["tested"])) == (4, 3)
    assert {outcome for _, outcome, _ in found["lerobot_eval"]} <= {"success", "horizon"}


HUB = """
import json, sys
import numpy as np
from lerobot_roborecover.curation.policy_trials import env_config
from lerobot_roborecover.platforms import make_simulator, platform_named
from lerobot_roborecover.scenario import Reset
given = ["--base.type=hub", f"--base.hub_path={sys.argv[1]}", "--trust_remote_code=true"]
config = env_config("lerobot", "none", given)
slot = config.run_spec().slot
simulator = make_simulator(slot.platform, **slot.options)
(task,) = platform_named(slot.platform).tasks(config.gym_kwargs)
hashes = []
for _ in range(2):
    simulator.reset(task, Reset(seed=5))
    for _ in range(30):
        simulator.step(np.ones(2))
    hashes.append(simulator.state_sha256())
print(json.dumps({
    "features": sorted(config.features), "task": [task.suite, task.name], "same": len(set(hashes)) == 1,
    "solved": simulator.succeeded(), "marks": simulator.fingerprint(),
}))
"""


@pytest.mark.nightly
@pytest.mark.lerobot
@pytest.mark.slow
def test_an_environment_on_the_hub_at_a_commit(tmp_path):
    with HubServer() as hub:
        hub.repos["lab/point"] = repo = Repo()
        code = (Path(__file__).parents[1] / "support" / "hub_env.py").read_bytes()
        sha = repo.commit({"env.py": code})
        done = HubClient(hub, tmp_path, tmp_path).run(HUB, f"lab/point@{sha}")
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["features"] == ["action", "agent_pos"]
    assert found["same"]
    assert found["solved"]
    assert found["marks"]["env.hub"] == f"lab/point@{sha}"


@pytest.mark.lerobot
def test_an_unknown_env_type_names_those_that_there_are():
    with pytest.raises(RoboRecoverError, match=r"no env type 'nonsense'.*pusht"):
        platform_named("lerobot_nonsense").tasks()
