"""Real-time evaluation: what is executed during inference, and that both loops agree on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.real_time import LatencyModel, RealTime
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.vector_env import create_recovery_envs
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.interventions.options import InterventionFacts
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.workers.messages import SlotConfig
from tests.support.factories import fake_dataset
from tests.support.loop import push_policy

TRIALS, CHUNK, HZ = 2, 4, 20.0


def column(*values):
    return np.array(values, float)[:, None]


def labels(sequence):
    return [int(v) for v in sequence[:, 0]]


@pytest.mark.parametrize(
    ("latency_s", "hz", "steps"), [(0, 20, 0), (0.15, 20, 3), (0.151, 20, 4), (0.001, 20, 1), (0.1, 80, 8)]
)
def test_an_inference_costs_whole_steps(latency_s, hz, steps):
    assert RealTime("hold", latency_s, 4).steps(99.0, hz) == steps
    assert RealTime("hold", None, 4).steps(latency_s, hz) == steps


def test_the_last_action_is_held():
    clock = LatencyModel(RealTime("hold", 0.1, 3), HZ)
    assert labels(clock.sequence(column(1, 2, 3), 9.0)) == [1, 2, 3], "there is nothing to hold yet"
    assert labels(clock.sequence(column(4, 5, 6), 9.0)) == [3, 3, 4, 5, 6]
    assert labels(clock.sequence(column(7, 8, 9), 9.0)) == [6, 6, 7, 8, 9]


def test_only_an_inference_is_charged_not_what_it_left():
    clock = LatencyModel(RealTime("hold", 0.05, 2), HZ)
    given_ = [labels(clock.sequence(column(k), 9.0)) for k in range(1, 6)]
    assert given_ == [[1], [2], [2, 3], [4], [4, 5]]


def test_what_was_measured_is_charged():
    clock = LatencyModel(RealTime("hold", None, 2), HZ)
    assert labels(clock.sequence(column(1, 2), 7.0)) == [1, 2], "an inference may compile at first"
    assert labels(clock.sequence(column(3, 4), 0.12)) == [2, 2, 2, 3, 4]
    assert labels(clock.sequence(column(5, 6), 0.0)) == [5, 6]


def test_the_chunk_goes_on():
    clock = LatencyModel(RealTime("chunk", 0.1, 6), HZ)
    assert labels(clock.sequence(column(10, 11, 12, 13, 14, 15), 9.0)) == [10, 11, 12, 13]
    assert labels(clock.sequence(column(20, 21, 22, 23, 24, 25), 9.0)) == [14, 15, 22, 23]
    assert labels(clock.sequence(column(30, 31, 32, 33, 34, 35), 9.0)) == [24, 25, 32, 33]


def test_a_chunk_shorter_than_the_thought_is_held_at_its_end():
    clock = LatencyModel(RealTime("chunk", 0.2, 3), HZ)
    assert labels(clock.sequence(column(10, 11, 12), 9.0)) == [10]
    assert labels(clock.sequence(column(20, 21, 22), 9.0)) == [11, 12, 12, 12]
    assert labels(clock.sequence(column(30, 31, 32), 9.0)) == [22, 22, 22, 22]


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.lists(st.floats(0, 0.6), min_size=1, max_size=12))
def test_every_action_of_a_chunk_comes_at_its_own_time(length, seconds):
    """Action i of an observation at time t is executed at t + i, but for what is held: the action before,
    and a chunk's last one."""
    clock = LatencyModel(RealTime("chunk", None, length), HZ)
    now, before, ends = 0, None, set()
    for number, took in enumerate(seconds):
        ends.add(now + length - 1)
        sent = clock.sequence(np.array([[number, now + i] for i in range(length)], float), took)
        assert len(sent)
        for time, action in enumerate(sent.tolist(), now):
            due = action[1]
            assert due == time or action == before or (due < time and due in ends)
            before = action
        now += len(sent)


def test_single_actions_have_no_chunk_that_could_go_on():
    clock = LatencyModel(RealTime("chunk", 0.1, 4), HZ)
    with pytest.raises(OptionError, match="one by one"):
        clock.sequence(column(1), 0.1)


# --- both loops


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 3, horizon=40)


class ChunkHost:
    """The test policy, which gives its action and lesser ones after it."""

    batched, max_batch = True, 8

    def noise(self, seed):
        return "per_trial"

    def start(self, seed):
        return None

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        state = np.stack([o["environment_state"] for o in observations])
        return list(chunks_of({"environment_state": state}))


def chunks_of(observation):
    """(B, CHUNK, 2)."""
    first = push_policy(observation)
    return np.stack([first * np.float32(1 - 0.1 * k) for k in range(CHUNK)], axis=1)


def engine(dataset, log, *, slots=2, horizon=CHUNK, **options):
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("fake"), {}, None),
        workers=True,
        facts=PolicyMetadata(policy="push", n_episodes=TRIALS, execution_horizon=horizon),
    )
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        run_work_items(run, units_of(list(scenarios), TRIALS), ChunkHost, EngineConfig(slots=slots))
    finally:
        run.pool.release()
    return read_trial_log(log)


def lerobots_loop(dataset, log, **options):
    """One trial at a time: LeRobot's loop, and a policy with a queue."""
    envs = create_recovery_envs(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("fake"), {}, None),
        n_envs=1,
        workers=False,
        facts=PolicyMetadata(policy="push", n_episodes=TRIALS, execution_horizon=CHUNK),
    )
    for env in [e for group in envs.values() for e in group.values()]:
        for trial in range(TRIALS):
            queue: list[np.ndarray] = []
            observation, _ = env.reset(seed=[1000 + trial])
            done = False
            while not done:
                queue = queue or list(chunks_of(observation)[0])
                observation, _, terminated, truncated, _ = env.step(queue.pop(0)[None])
                done = bool((terminated | truncated).all())
        env.close()
    return read_trial_log(log)


def facts(rows):
    return {(r.scenario_id, r.trial): (r.outcome, r.steps, r.actions_sha256) for r in rows}


@pytest.fixture(scope="module")
def frozen(dataset, tmp_path_factory):
    return engine(dataset, tmp_path_factory.mktemp("frozen") / "log.jsonl")


@pytest.mark.nightly
@pytest.mark.slow
def test_no_latency_is_a_frozen_clock(dataset, frozen, tmp_path):
    for during_inference in ("hold", "chunk"):
        rows = engine(
            dataset,
            tmp_path / f"{during_inference}.jsonl",
            slots=1,
            realtime=True,
            latency_s=0.0,
            during_inference=during_inference,
        )
        assert facts(rows) == facts(frozen)
        assert {r.options["realtime"] for r in rows} == {during_inference}
        assert {r.config_hash for r in rows}.isdisjoint(r.config_hash for r in frozen)
    assert not {"realtime", "latency_s", "during_inference"} & set(frozen[0].options)
    assert any(r.success for r in frozen)


@pytest.mark.slow
def test_given_latency_is_deterministic_and_the_same_in_both_loops(dataset, frozen, tmp_path):
    options = {"realtime": True, "latency_s": 0.12}
    rows = engine(dataset, tmp_path / "a.jsonl", **options)
    stock = lerobots_loop(dataset, tmp_path / "c.jsonl", **options)
    assert facts(rows) == facts(stock)
    assert {r.config_hash for r in rows} == {r.config_hash for r in stock}
    assert rows[0].options["latency_s"] == 0.12
    assert all(r.steps <= 40 for r in rows)
    assert facts(rows) != facts(frozen)
    going_on = engine(dataset, tmp_path / "chunk.jsonl", during_inference="chunk", **options)
    assert facts(going_on) == facts(
        engine(dataset, tmp_path / "d.jsonl", slots=1, during_inference="chunk", **options)
    )
    assert facts(going_on) != facts(rows)


def test_measured_latency_is_marked(dataset, tmp_path):
    rows = engine(dataset, tmp_path / "a.jsonl", slots=1, realtime=True)
    assert {r.options["latency_s"] for r in rows} == {"measured"}
    assert {r.outcome for r in rows} <= {"success", "horizon"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"realtime": True, "during_inference": "wait"}, "not one of"),
        ({"realtime": True, "latency_s": -1.0}, "from 0 to 600"),
        ({"latency_s": 0.1}, "with --env.realtime=true only"),
        ({"during_inference": "chunk"}, "with --env.realtime=true only"),
    ],
)
def test_options_that_are_refused(options, words):
    with pytest.raises(OptionError, match=words):
        RecoveryOptions(**options).check()


def test_what_cannot_be_charged_is_refused(dataset, tmp_path):
    options = RecoveryOptions(scenarios=str(dataset), trial_log=str(tmp_path / "log.jsonl"), realtime=True)
    part = SimulatorSpec(SlotConfig("fake"), {}, None)
    with pytest.raises(OptionError, match=r"name --policy\.n_action_steps"):
        create_session(options, part, workers=False)
    human = InterventionFacts("reversion", 3, {"base": "push"})
    with pytest.raises(OptionError, match="interventions take the frozen clock"):
        create_session(
            options, part, workers=False, facts=PolicyMetadata(execution_horizon=1, intervention=human)
        )
    options.during_inference = "chunk"
    with pytest.raises(OptionError, match=r"Use roborecover eval, or --env\.during_inference=hold"):
        create_recovery_envs(
            options, part, n_envs=1, workers=False, facts=PolicyMetadata(execution_horizon=2)
        )
