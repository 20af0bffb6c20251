"""Real LeRobot policies in batches: each slot's history and noise are its own, as at batch 1."""

from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.vector_env import create_recovery_envs
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.row import trial_seed
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.runner import PolicyError
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.workers.messages import SlotConfig
from tests.support.factories import fake_dataset, fake_scenario, save_policy
from tests.support.loop import outcomes
from tests.support.small_policies import small_smolvla

pytestmark = pytest.mark.lerobot

TRIALS = 2


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=12)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    return {kind: save_policy(tmp_path_factory.mktemp(kind), kind) for kind in ("act", "diffusion")}


def load(folder, kind, **changes):
    """Policy, preprocessor and postprocessor, as `lerobot-eval` would have them."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    config = PreTrainedConfig.from_pretrained(folder)
    for name, value in changes.items():
        setattr(config, name, value)
    policy = get_policy_class(kind).from_pretrained(folder, config=config)
    policy.eval()
    return policy, *make_pre_post_processors(config, pretrained_path=str(folder))


def host_of(folder, kind, max_batch=64, tracebacks=True, **changes):
    from lerobot_roborecover.policies.local_runner import LocalPolicyRunner

    policy, pre, post = load(folder, kind, **changes)
    return LocalPolicyRunner(
        policy, lambda batch: batch, lambda action: action, pre, post, max_batch, tracebacks=tracebacks
    )


def engine_rows(dataset, log, host, slots):
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log)),
        SimulatorSpec(SlotConfig("fake"), {}, None),
        workers=True, facts=PolicyMetadata(policy="p", n_episodes=TRIALS),
    )  # fmt: skip
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        run_work_items(run, units_of(list(scenarios), TRIALS), lambda: host, EngineConfig(slots=slots))
    finally:
        run.pool.release()
    return read_trial_log(log)


def stock_rows(dataset, log, folder, kind, **changes):
    """LeRobot's own `rollout`, batch 1."""
    from lerobot.scripts.lerobot_eval import rollout

    policy, pre, post = load(folder, kind, **changes)
    envs = create_recovery_envs(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log)),
        SimulatorSpec(SlotConfig("fake"), {}, None),
        n_envs=1, workers=True, facts=PolicyMetadata(policy="p", n_episodes=TRIALS),
    )  # fmt: skip
    flat = [env for group in envs.values() for env in group.values()]
    for env in flat:
        for trial in range(TRIALS):
            rollout(env, policy, lambda b: b, lambda a: a, pre, post, seeds=[1000 + trial])
    for env in flat:
        env.close()
    return read_trial_log(log)


@pytest.mark.parametrize(("kind", "slots"), [("act", 1), ("diffusion", 1), ("diffusion", 4)])
def test_the_same_rows_as_lerobots_rollout(dataset, checkpoints, tmp_path, kind, slots):
    """Bit for bit wherever the policy sees one observation at a time."""
    stock = stock_rows(dataset, tmp_path / "stock.jsonl", checkpoints[kind], kind)
    rows = engine_rows(dataset, tmp_path / "fast.jsonl", host_of(checkpoints[kind], kind), slots)
    assert outcomes(rows) == outcomes(stock)
    assert {r.noise for r in rows} == {"per_trial"}
    if kind == "diffusion":
        assert len({r.actions_sha256 for r in rows}) == len(rows), "the policy must be stochastic"


def test_temporal_ensembling_keeps_a_history_per_slot(dataset, checkpoints, tmp_path):
    changes = {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1}
    stock = stock_rows(dataset, tmp_path / "stock.jsonl", checkpoints["act"], "act", **changes)
    host = host_of(checkpoints["act"], "act", **changes)
    assert not host.batched
    assert outcomes(engine_rows(dataset, tmp_path / "fast.jsonl", host, 3)) == outcomes(stock)


def observation_of(index: int) -> dict:
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    hand_off(simulator, fake_scenario(index))
    return simulator.observe()


def ask(host, seeds: list[int], observations: list[dict], rounds: int = 2) -> list[np.ndarray]:
    """(rounds x horizon, A) actions of every slot."""
    histories = [host.start(seed) for seed in seeds]
    chunks = [host.act(observations, ["push"] * len(seeds), histories) for _ in range(rounds)]
    return [np.concatenate([c[i] for c in chunks]) for i in range(len(seeds))]


def test_a_batch_gives_each_slot_what_it_gets_alone(checkpoints):
    host = host_of(checkpoints["act"], "act")
    states = [observation_of(i) for i in range(5)]
    for state in states:
        del state["pixels"]
    together = ask(host, list(range(5)), states)
    for seed, (state, actions) in enumerate(zip(states, together, strict=True)):
        np.testing.assert_allclose(actions, ask(host, [seed], [state])[0], rtol=1e-4, atol=1e-4)
        assert actions.shape == (4, 2)


@pytest.mark.parametrize("tracebacks", [True, False])
def test_a_traceback_is_logged_once_where_it_is_asked_for(checkpoints, tracebacks, caplog):
    host = host_of(checkpoints["act"], "act", tracebacks=tracebacks)
    lacking = {"agent_pos": np.zeros(3, np.float32)}
    for seed in (1, 2):
        (answer,) = host.act([lacking], ["go"], [host.start(seed)])
        assert isinstance(answer, PolicyError)
    assert caplog.text.count("the policy raised") == 2
    assert caplog.text.count("Traceback") == int(tracebacks)


def test_mixed_precision_on_a_cpu_gives_actions_that_numpy_has(checkpoints):
    """bfloat16, as float32."""
    plain, mixed = (
        ask(host_of(checkpoints["act"], "act", use_amp=amp), [5], [observation_of(0)], rounds=1)[0]
        for amp in (False, True)
    )
    assert mixed.dtype == plain.dtype == np.float32
    assert np.allclose(mixed, plain, atol=0.05)
    assert not np.array_equal(mixed, plain)


def test_weights_are_shared_and_histories_are_not(checkpoints):
    host = host_of(checkpoints["diffusion"], "diffusion")
    one, two = host.start(1), host.start(2)
    pairs = zip(one.policy.parameters(), two.policy.parameters(), strict=True)
    assert all(a is b for a, b in pairs)
    assert one.policy._queues is not two.policy._queues
    host.finish(one)
    assert host.start(3).policy._queues["action"].maxlen, "an instance given back is used again, reset"


@pytest.fixture
def smolvla(tmp_path, monkeypatch):
    from lerobot_roborecover.policies.local_runner import LocalPolicyRunner

    policy, preprocessor = small_smolvla(tmp_path / "vlm", monkeypatch)

    def make(max_batch=64):
        return LocalPolicyRunner(policy, lambda b: b, lambda a: a, preprocessor, lambda a: a, max_batch)

    return policy, preprocessor, make


def test_noise_of_a_vla_belongs_to_the_trial(smolvla):
    _, _, make = smolvla
    host = make()
    assert host.noise(1000) == "per_trial"
    observations = [observation_of(i) for i in range(4)]
    together = ask(host, [3, 1, 4, 5], observations)
    reordered = ask(host, [5, 4, 1, 3], observations[::-1])[::-1]
    for i, seed in enumerate([3, 1, 4, 5]):
        alone = ask(host, [seed], [observations[i]])[0]
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=1e-4)
        np.testing.assert_allclose(reordered[i], alone, rtol=0, atol=1e-4)
    other = ask(host, [9], [observations[0]])[0]
    assert np.abs(other - together[0]).max() > 1e-2, "the noise must matter"


def test_a_vla_draws_what_it_draws_under_lerobot_at_batch_1(smolvla):
    import torch
    from lerobot.envs import preprocess_observation

    policy, preprocessor, make = smolvla
    observation = observation_of(0)
    seed = trial_seed(1000, "fake", 0)
    actions = ask(make(), [seed], [observation])[0]
    torch.manual_seed(seed)
    policy.reset()
    stock = []
    with torch.inference_mode():
        for _ in range(6):  # two inferences of three actions each
            batch = preprocess_observation({k: v[None] for k, v in observation.items()})
            stock.append(policy.select_action(preprocessor(batch))[0].numpy())
    np.testing.assert_array_equal(actions, np.stack(stock))


def test_the_callers_own_generator_is_left_alone(smolvla):
    import torch

    _, _, make = smolvla
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    ask(make(), [1, 2], [observation_of(0), observation_of(1)])
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("family", ["pi0", "pi05", "smolvla"])
def test_families_that_are_given_noise_take_it(family):
    """LeRobot passes `predict_action_chunk(noise=...)` on to `sample_actions`, which draws this shape."""
    import importlib

    module = importlib.import_module(f"lerobot.policies.{family}.modeling_{family}")
    name = {"pi0": "PI0Pytorch", "pi05": "PI05Pytorch", "smolvla": "VLAFlowMatching"}[family]
    sample = getattr(module, name).sample_actions
    assert "noise" in inspect.signature(inspect.unwrap(sample)).parameters
    source = "".join(inspect.getsource(inspect.unwrap(sample)).split())
    assert "bsize,self.config.chunk_size,self.config.max_action_dim" in source


def test_a_policy_that_draws_inside_is_marked_in_a_batch(smolvla, monkeypatch):
    from lerobot_roborecover.policies import local_runner

    monkeypatch.setattr(local_runner, "STATELESS", {"smolvla": "inside"})
    _, _, make = smolvla
    assert make().noise(1000) == "per_batch"
    assert make(max_batch=1).noise(1000) == "per_trial"
    assert make().noise(None) == "unseeded"
    alone = [ask(make(1), [3], [observation_of(0)])[0] for _ in range(2)]
    np.testing.assert_array_equal(*alone)


def test_an_observation_that_breaks_the_policy_costs_its_slot_alone(smolvla):
    _, _, make = smolvla
    good, bad = observation_of(0), observation_of(1)
    bad["agent_pos"] = np.zeros(9)
    host = make()
    histories = [host.start(s) for s in (1, 2, 3)]
    first, second, third = host.act([good, bad, good], ["push"] * 3, histories)
    assert isinstance(second, PolicyError)
    np.testing.assert_allclose(first, ask(host, [1], [good], 1)[0], rtol=0, atol=1e-4)
    np.testing.assert_allclose(third, ask(host, [3], [good], 1)[0], rtol=0, atol=1e-4)


def test_out_of_memory_halves_the_batch_and_goes_on(smolvla, monkeypatch):
    import torch

    policy, _, make = smolvla
    observations = [observation_of(i) for i in range(4)]
    expected = ask(make(), [0, 1, 2, 3], observations, 1)
    whole = policy.predict_action_chunk

    def small_gpu(batch, **kwargs):
        if len(batch["observation.state"]) > 2:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return whole(batch, **kwargs)

    monkeypatch.setattr(policy, "predict_action_chunk", small_gpu)
    host = make()
    for got, want in zip(ask(host, [0, 1, 2, 3], observations, 1), expected, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-4)
    assert host.max_batch == 2
