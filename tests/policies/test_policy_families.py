"""The paper's native families, small and random, through both evaluators: each slot has its own history."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.cli.main import main
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.policies.runner import PolicyError
from lerobot_roborecover.replay.handoff import hand_off
from tests.support.exactness import row_as_recorded
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import outcomes
from tests.support.small_families import FAMILIES, IMAGE, fix_sizes, save_family
from tests.support.small_hub import make_hub

pytestmark = [pytest.mark.lerobot, pytest.mark.slow]

FEW = ("pi05", "smolvla")
"""Families of the default run; the others are `nightly`."""
EVERY = [f if f in FEW else pytest.param(f, marks=pytest.mark.nightly) for f in FAMILIES]
NOISE = {"pi0": "per_trial", "pi05": "per_trial", "smolvla": "per_trial", "xvla": "per_batch",
         "fastwam": "per_trial", "lingbot_va": "per_trial"}  # fmt: skip
"""What a row of a batched run says about a family's noise."""
RENAME = f'--rename_map={{"observation.image": "{IMAGE}"}}'


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    """A cache with the tiny stand-ins of what the families load by name, in force for the whole module."""
    from huggingface_hub import constants

    cache = make_hub(tmp_path_factory.mktemp("hub"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "HF_HUB_CACHE", str(cache))
        fix_sizes(patch.setattr)
        yield cache


@pytest.fixture(scope="module")
def checkpoint(hub, tmp_path_factory):
    """Checkpoints by family and action width, each saved once."""
    made: dict[tuple, Path] = {}

    def get(family: str, action: int = 2) -> Path:
        if (family, action) not in made:
            folder = tmp_path_factory.mktemp(f"{family}{action}") / family
            made[family, action] = save_family(folder, family, hub, action=action)
        return made[family, action]

    return get


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 2, horizon=5)


@pytest.fixture(scope="module")
def metaworld(tmp_path_factory):
    scenario = load_scenarios("metaworld_starter")[0]
    short = replace(scenario, task=replace(scenario.task, horizon=4))
    return write_scenarios(tmp_path_factory.mktemp("metaworld") / "set", [short])


@pytest.fixture
def roborecover_eval(monkeypatch, tmp_path):
    def run(*args: str) -> Path:
        monkeypatch.setattr(sys, "argv", ["roborecover"])
        assert main(["eval", *args, "--policy.device=cpu", f"--output_dir={tmp_path / 'fast'}"]) == 0
        return tmp_path / "fast"

    return run


@pytest.mark.parametrize("family", EVERY)
def test_both_evaluators_give_the_same_rows(run_lerobot_eval, roborecover_eval, checkpoint, dataset, family):
    """Bit for bit where the policy is asked about one observation at a time."""
    common = (
        "--env=roborecover_fake", "--env.obs_type=pixels_agent_pos", f"--env.scenarios={dataset}",
        f"--policy.path={checkpoint(family)}", RENAME, "--eval.n_episodes=2",
    )  # fmt: skip
    stock = run_lerobot_eval(*common, "--eval.batch_size=1", "--eval.use_async_envs=false")
    fast = roborecover_eval(*common, "--runner.slots=3", "--runner.max_batch=1")
    expected = read_trial_log(stock / "trials.jsonl")
    rows = read_trial_log(fast / "trials.jsonl")
    assert {r.outcome for r in expected} <= {"horizon", "success"}
    assert outcomes(rows) == outcomes(expected)
    assert {r.noise for r in rows} == {"per_trial"}
    if family != "fastwam":  # its inference_seed is fixed
        assert len({r.actions_sha256 for r in rows}) == len(rows) == 4


@pytest.mark.metaworld
@pytest.mark.render
@pytest.mark.nightly
@pytest.mark.parametrize("family", FAMILIES)
def test_on_a_real_simulator_in_batches(run_lerobot_eval, roborecover_eval, checkpoint, metaworld, family):
    common = (
        "--env=roborecover_metaworld", "--env.observation_height=32", "--env.observation_width=32",
        f"--env.scenarios={metaworld}", f"--policy.path={checkpoint(family, 4)}", RENAME,
    )  # fmt: skip
    rows = read_trial_log(
        roborecover_eval(*common, "--eval.n_episodes=2", "--runner.slots=2") / "trials.jsonl"
    )
    assert [(r.outcome, r.steps, row_as_recorded(r)) for r in rows] == [("horizon", 4, True)] * 2
    assert {r.noise for r in rows} == {NOISE[family]}
    assert {r.batch_size for r in rows} == {1 if family == "lingbot_va" else 64}
    stock = run_lerobot_eval(
        *common, "--eval.n_episodes=1", "--eval.batch_size=1", "--eval.use_async_envs=false"
    )
    (row,) = read_trial_log(stock / "trials.jsonl")
    assert (row.outcome, row.steps) == ("horizon", 4)


def observation_of(index: int) -> dict:
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    hand_off(simulator, fake_scenario(index))
    observation = simulator.observe()
    observation["pixels"] = np.roll(observation["pixels"], 5 * index, axis=0)
    return observation


def load(folder: Path, **changes):
    """The host of `roborecover eval` for a checkpoint."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import make_policy, make_pre_post_processors

    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.evaluation.lerobot_introspection import env_processors
    from lerobot_roborecover.policies.local_runner import LocalPolicyRunner

    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    for name, value in changes.items():
        setattr(config, name, value)
    env = ENV_TYPES["fake"](obs_type="pixels_agent_pos")
    rename = {"observation.image": IMAGE}
    policy = make_policy(config, env_cfg=env, rename_map=rename)
    policy.eval()
    pre, post = make_pre_post_processors(
        config, pretrained_path=str(folder),
        preprocessor_overrides={"rename_observations_processor": {"rename_map": rename}},
    )  # fmt: skip
    return LocalPolicyRunner(policy, *env_processors(env, config), pre, post)


def ask(host, seeds: list[int], observations: list[dict], rounds: int = 2) -> list[np.ndarray]:
    """Actions of every slot, inference after inference."""
    histories = [host.start(seed) for seed in seeds]
    chunks = [
        [np.atleast_2d(c) for c in host.act(observations, ["push"] * len(seeds), histories)]
        for _ in range(rounds)
    ]
    for history in histories:
        host.finish(history)
    return [np.concatenate([c[i] for c in chunks]) for i in range(len(seeds))]


@pytest.mark.parametrize("family", EVERY)
def test_a_trials_actions_do_not_depend_on_its_batch(checkpoint, family, monkeypatch):
    """Nor on the order. X-VLA's noise is drawn inside, per batch: with that held, neither do its actions."""
    import torch

    host = load(checkpoint(family))
    if family == "xvla":
        draw = torch.randn

        def the_same_for_all(count, *shape, **kwargs):
            return draw(1, *shape, generator=torch.Generator().manual_seed(0)).expand(count, *shape).clone()

        monkeypatch.setattr(torch, "randn", the_same_for_all)
    observations = [observation_of(i) for i in range(3)]
    rounds = 4 if family == "lingbot_va" else 2  # past its first chunk, into the KV cache
    together = ask(host, [3, 1, 4], observations, rounds)
    reordered = ask(host, [4, 1, 3], observations[::-1], rounds)[::-1]
    for seed, observation, actions, again in zip([3, 1, 4], observations, together, reordered, strict=True):
        alone = ask(host, [seed], [observation], rounds)[0]
        np.testing.assert_allclose(actions, alone, rtol=0, atol=1e-4)
        np.testing.assert_allclose(again, alone, rtol=0, atol=1e-4)
    assert np.abs(together[0] - together[1]).max() > 1e-2, "what is seen must matter"


@pytest.mark.nightly
def test_an_instance_per_slot_costs_history_alone(checkpoint):
    """LingBot-VA's frozen VAE and text encoder, 20 GB of them, are outside of its registered modules."""
    host = load(checkpoint("lingbot_va"))
    one, two = host.start(1), host.start(2)
    for name in ("vae", "text_encoder"):
        pairs = zip(one.policy._frozen[name].parameters(), two.policy._frozen[name].parameters(), strict=True)
        assert all(a is b for a, b in pairs)
    assert one.policy.transformer.proj_out.weight is two.policy.transformer.proj_out.weight
    assert one.policy._frozen["streaming_vae"] is not two.policy._frozen["streaming_vae"]
    observation = observation_of(0)
    host.act([observation], ["push"], [one])
    cache = one.policy.transformer.blocks[0].attn1.attn_caches["pos"]["k"].clone()
    host.finish(two)
    fresh = host.start(5)  # the instance given back, reset
    host.act([observation], ["push"], [fresh])
    assert torch_equal(one.policy.transformer.blocks[0].attn1.attn_caches["pos"]["k"], cache)
    assert one.policy._frame_st_id == fresh.policy._frame_st_id == 0
    assert one.policy._action_queue is not fresh.policy._action_queue


def torch_equal(a, b) -> bool:
    import torch

    return torch.equal(torch.nan_to_num(a), torch.nan_to_num(b))


def test_an_observation_that_breaks_a_policy_costs_its_slot_alone(checkpoint):
    host = load(checkpoint("pi05"))
    good, bad = observation_of(0), observation_of(1)
    bad["agent_pos"] = np.zeros(9)
    histories = [host.start(s) for s in (1, 2)]
    first, second = host.act([good, bad], ["push"] * 2, histories)
    assert isinstance(second, PolicyError)
    np.testing.assert_allclose(first, ask(host, [1], [good], 1)[0], rtol=0, atol=1e-4)


@pytest.mark.nightly
def test_a_fast_wam_without_a_fixed_seed_draws_per_trial(checkpoint):
    host = load(checkpoint("fastwam"), inference_seed=None)
    assert host.noise(1000) == "per_batch"
    one, two = ask(host, [1], [observation_of(0)]), ask(host, [2], [observation_of(0)])
    assert np.abs(one[0] - two[0]).max() > 1e-2
    fixed = load(checkpoint("fastwam"))
    np.testing.assert_array_equal(*(ask(fixed, [s], [observation_of(0)])[0] for s in (1, 2)))


@pytest.mark.nightly
def test_a_batch_for_a_policy_of_one_environment_is_refused(run_lerobot_eval, checkpoint, dataset):
    """LeRobot's LingBot-VA would mix the pictures of all environments into one."""
    from lerobot_roborecover.errors import OptionError

    with pytest.raises(OptionError, match="keeps the history of one environment"):
        run_lerobot_eval(
            "--env=roborecover_fake", "--env.obs_type=pixels_agent_pos", f"--env.scenarios={dataset}",
            f"--policy.path={checkpoint('lingbot_va')}", RENAME, "--eval.n_episodes=2",
            "--eval.batch_size=2", "--eval.use_async_envs=false",
        )  # fmt: skip


# --- RoboTwin


def robotwin_observation() -> dict:
    rng = np.random.default_rng(0)
    colours = {"head_camera": 50, "left_camera": 120, "right_camera": 200}
    pose = [0.3, 0.1, 0.9, 0.5, 0.5, -0.5, 0.5, 1.0]
    return {
        "pixels": {name: np.full((240, 320, 3), value, np.uint8) for name, value in colours.items()},
        "agent_pos": rng.normal(0, 1, 14).astype(np.float32),
        "endpose": np.array([*pose, *np.multiply(pose, [-1, 1, 1, 1, 1, 1, 1, 0])], np.float32),
    }


def robotwin_host(folder: Path, rename: dict | None = None, **options):
    """The host of `roborecover eval --env.type=roborecover_robotwin`."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import make_policy, make_pre_post_processors

    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.evaluation.lerobot_introspection import env_processors
    from lerobot_roborecover.policies.local_runner import LocalPolicyRunner

    env = ENV_TYPES["robotwin"](**options)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = make_policy(config, env_cfg=env, rename_map=rename or {})
    policy.eval()
    pre, post = make_pre_post_processors(
        config, pretrained_path=str(folder),
        preprocessor_overrides={"rename_observations_processor": {"rename_map": rename or {}}},
    )  # fmt: skip
    return LocalPolicyRunner(policy, *env_processors(env, config), pre, post)


ROBOTWIN_CAMERAS = tuple(f"observation.images.{name}_camera" for name in ("head", "left", "right"))


@pytest.mark.nightly
def test_x_vla_on_robotwin_moves_joints(hub, tmp_path):
    """A checkpoint of LeRobot's own training: nothing of LIBERO's is done to it."""
    folder = save_family(tmp_path / "xvla", "xvla", hub, state=14, action=14, images=ROBOTWIN_CAMERAS)
    host = robotwin_host(folder)
    observation = robotwin_observation()
    (chunk,) = host.act([observation], ["push"], [host.start(1)])
    assert chunk.shape == (3, 14)
    batch = host.env_batch([observation], ["push"])
    np.testing.assert_array_equal(batch["observation.state"][0], observation["agent_pos"])
    assert float(batch[ROBOTWIN_CAMERAS[0]].max()) == pytest.approx(50 / 255), "not normalised twice"


@pytest.mark.nightly
def test_x_vla_on_robotwin_moves_end_effectors(hub, tmp_path):
    """The paper's: absolute poses of 20 values in and out, as its release reads and writes them."""
    from scipy.spatial.transform import Rotation

    folder = save_family(
        tmp_path / "xvla", "xvla", hub, state=20, action=20, images=ROBOTWIN_CAMERAS, action_mode="ee6d"
    )
    host = robotwin_host(folder, action_mode="ee", control_mode="absolute")
    observation = robotwin_observation()
    state = host.env_batch([observation], ["push"])["observation.state"][0].numpy()
    columns = Rotation.from_quat(observation["endpose"][3:7]).as_matrix()[:, :2]
    np.testing.assert_allclose(state[:3], observation["endpose"][:3])
    np.testing.assert_allclose(state[3:9], columns.reshape(-1), atol=1e-6)
    assert (state[9], state[19]) == (-1.0, 1.0), "open is -1, closed 1"
    (chunk,) = host.act([observation], ["push"], [host.start(1)])
    assert chunk.shape == (3, 16)
    for arm in (chunk[:, :8], chunk[:, 8:]):
        np.testing.assert_allclose(np.linalg.norm(arm[:, 3:7], axis=1), 1, atol=1e-6)
        assert set(arm[:, 7]) <= {-1.0, 1.0}


def test_x_vlas_rotations_survive_the_way_there_and_back():
    import torch
    from scipy.spatial.transform import Rotation

    from lerobot_roborecover.platforms.robotwin.processors import XVLAActionStep, XVLAStateStep

    turns = Rotation.random(6, random_state=0)
    poses = np.zeros((6, 16))
    poses[:, 3:7] = poses[:, 11:15] = turns.as_quat()
    state = XVLAStateStep().observation({"observation.endpose": torch.from_numpy(poses)})["observation.state"]
    action = XVLAActionStep()({"action": state.clone()})["action"].numpy()
    for arm in (action[:, 3:7], action[:, 11:15]):
        np.testing.assert_allclose((Rotation.from_quat(arm) * turns.inv()).magnitude(), 0, atol=1e-5)
    with pytest.raises(ValueError, match="action_mode=joint"):
        XVLAActionStep()({"action": torch.zeros(1, 14)})


def test_fast_wam_sees_all_cameras_in_one_picture():
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES
    from lerobot_roborecover.evaluation.lerobot_introspection import env_processors

    env = ENV_TYPES["robotwin"](mosaic=True)
    assert env.features["pixels/mosaic"].shape == (384, 320, 3)
    assert "pixels/head_camera" not in env.features
    pre, _ = env_processors(env, None)
    from lerobot.envs import preprocess_observation

    raw = robotwin_observation()
    batch = preprocess_observation(
        {"pixels": {k: v[None] for k, v in raw["pixels"].items()}, "agent_pos": raw["agent_pos"][None]}
    )
    batch["task"] = ["push"]
    out = pre(batch)
    picture = out["observation.images.mosaic"][0].numpy() * 255
    assert picture.shape == (3, 384, 320)
    np.testing.assert_allclose(picture[:, :256], 50, atol=1)
    np.testing.assert_allclose(picture[:, 256:, :160], 120, atol=1)
    np.testing.assert_allclose(picture[:, 256:, 160:], 200, atol=1)
    assert [k for k in out if "images" in k] == ["observation.images.mosaic"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"control_mode": "absolute"}, "action_mode=ee"),
        ({"action_mode": "ee", "control_mode": "sideways"}, "relative, absolute"),
        ({"mosaic": True, "camera_names": "head_camera"}, "all three cameras"),
    ],
)
def test_robotwin_options_that_contradict_each_other(options, words):
    from lerobot_roborecover.errors import OptionError
    from lerobot_roborecover.evaluation.env_configs import ENV_TYPES

    with pytest.raises(OptionError, match=words):
        ENV_TYPES["robotwin"](**options).run_spec()


def test_an_actions_width_is_the_runs_and_not_the_prefixs():
    """LingBot-VA gives 16 values on scenarios that were recorded with 14."""
    from types import SimpleNamespace

    from lerobot_roborecover.evaluation.session import EvalSession
    from lerobot_roborecover.policies.action_checks import action_problem

    scenario = SimpleNamespace(platform="robotwin", prefix=np.zeros((3, 14)))
    for mode, width in (("joint", 14), ("ee", 16)):
        pool = SimpleNamespace(config=SimpleNamespace(options={"action_mode": mode}))
        run = EvalSession(pool, None, None, "d", None)
        assert run.action_width(scenario) == width
        assert not action_problem(scenario, np.zeros(width), run.action_width(scenario))
        assert "16" in action_problem(scenario, np.zeros(30 - width), run.action_width(scenario))
