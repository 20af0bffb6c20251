"""The fast engine gives the same rows as LeRobot's loop, and loses no trial to a broken part."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.evaluation.launch import EngineConfig, run_work_items
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import WorkItem, WorkQueue, first_units, units_of
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.runner import PolicyError
from lerobot_roborecover.workers.messages import SlotConfig
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import evaluate, outcomes, push_policy

TRIALS = 3


class PushHost:
    """The deterministic test policy, plus noise of each trial's own, one action at a time."""

    batched = True

    def __init__(self, max_batch: int = 64, noise: float = 0.0, fail=lambda observation: False):
        self.max_batch, self._noise, self._fail = max_batch, noise, fail
        self.batches: list[int] = []

    def noise(self, seed):
        return "per_trial"

    def start(self, seed):
        return np.random.default_rng(seed)

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        self.batches.append(len(observations))
        batch = {"environment_state": np.stack([o["environment_state"] for o in observations])}
        noise = np.stack([h.normal(0.0, 1.0, 2) for h in histories]) * self._noise
        chunks = (push_policy(batch) + noise.astype(np.float32))[:, None]
        broken = PolicyError("the policy broke on purpose")
        return [broken if self._fail(o) else c for o, c in zip(observations, chunks, strict=True)]


def run_engine(dataset, log, *, slots=3, host=None, stop=lambda: False, step_s=0.0, **options):
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("fake", {"step_s": step_s}), {}, None),
        workers=True,
        facts=PolicyMetadata(policy="push", n_episodes=TRIALS),
    )
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        units = units_of(list(scenarios), TRIALS)
        run_work_items(run, units, lambda: host or PushHost(), EngineConfig(slots=slots), stop=stop)
    finally:
        run.pool.release()
    return read_trial_log(log)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", 6)


@pytest.fixture(scope="module")
def reference(dataset, tmp_path_factory):
    return outcomes(evaluate(dataset, tmp_path_factory.mktemp("r") / "log.jsonl", trials=TRIALS, batch=1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slots", "max_batch"),
    [(4, 2), *(pytest.param(*sizes, marks=pytest.mark.nightly) for sizes in ((1, 64), (2, 1), (5, 64)))],
)
def test_the_same_rows_as_lerobots_loop(dataset, reference, tmp_path, slots, max_batch):
    host = PushHost(max_batch)
    assert outcomes(run_engine(dataset, tmp_path / "log.jsonl", slots=slots, host=host)) == reference
    assert max(host.batches) <= max_batch


@pytest.mark.slow
def test_trials_of_different_scenarios_share_a_batch(dataset, tmp_path):
    host = PushHost()
    run_engine(dataset, tmp_path / "log.jsonl", slots=4, host=host)
    assert max(host.batches) > 1


@pytest.mark.slow
def test_noise_belongs_to_the_trial_not_to_the_batch(dataset, tmp_path):
    one = outcomes(run_engine(dataset, tmp_path / "1.jsonl", slots=1, host=PushHost(noise=0.3)))
    many = outcomes(run_engine(dataset, tmp_path / "4.jsonl", slots=4, host=PushHost(noise=0.3)))
    assert one == many
    assert len({sha for _, _, sha, _ in one.values()}) == len(one)


@pytest.mark.slow
@settings(max_examples=2, deadline=None)
@given(stops=st.lists(st.integers(0, 200), max_size=3))
def test_stopped_and_resumed(dataset, reference, tmp_path_factory, stops):
    log = tmp_path_factory.mktemp("s") / "log.jsonl"
    for events in stops:
        left = iter(range(events))
        run_engine(dataset, log, stop=lambda left=left: next(left, None) is None)
    assert outcomes(run_engine(dataset, log)) == reference


@pytest.mark.slow
def test_lerobots_loop_resumes_an_engine_run_and_the_other_way_round(dataset, reference, tmp_path):
    left = iter(range(150))
    run_engine(dataset, tmp_path / "a.jsonl", stop=lambda: next(left, None) is None)
    assert outcomes(evaluate(dataset, tmp_path / "a.jsonl", trials=TRIALS, batch=3)) == reference
    evaluate(dataset, tmp_path / "b.jsonl", trials=TRIALS, batch=3, stop_after_batches=3)
    assert outcomes(run_engine(dataset, tmp_path / "b.jsonl")) == reference


@pytest.mark.slow
def test_a_policy_that_raises_costs_the_trial_that_made_it(dataset, reference, tmp_path):
    bad = fake_scenario(3)
    mark = [float(x) for x in bad.fingerprint.bodies["puck"].position_m[:2]]
    host = PushHost(fail=lambda o: o["environment_state"][2:4].tolist() == mark)
    rows = run_engine(dataset, tmp_path / "log.jsonl", slots=4, host=host)
    broken = {r.scenario_id for r in rows if r.outcome == "policy_error"}
    assert broken == {bad.id}
    assert all("broke on purpose" in r.reason for r in rows if r.outcome == "policy_error")
    others = {k: v for k, v in outcomes(rows).items() if k[0] != bad.id}
    assert others == {k: v for k, v in reference.items() if k[0] != bad.id}


@pytest.mark.slow
def test_a_scenario_that_keeps_breaking_is_parked(tmp_path):
    good, bad = fake_scenario(0), fake_scenario(1, name="exits", suite="faults")
    root = write_scenarios(tmp_path / "set", [good, bad])
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(root), trial_log=str(tmp_path / "log.jsonl")),
        SimulatorSpec(SlotConfig("fake"), {}, None), workers=True,
        facts=PolicyMetadata(policy="push", n_episodes=6),
    )  # fmt: skip
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    run_work_items(run, units_of(list(scenarios), 6), PushHost, EngineConfig(slots=2))
    run.pool.release()
    rows = [r for r in read_trial_log(tmp_path / "log.jsonl") if r.scenario_id == bad.id]
    assert {r.outcome for r in rows} == {"sim_error"}
    assert len(rows) == 6
    assert Counter(r.reason.startswith("not tried") for r in rows)[True] >= 2


@pytest.mark.nightly
@pytest.mark.slow
def test_a_hung_simulator_becomes_a_timeout(tmp_path):
    root = write_scenarios(
        tmp_path / "set", [fake_scenario(0), fake_scenario(1, name="hangs", suite="faults")]
    )
    rows = run_engine(root, tmp_path / "log.jsonl", slots=2, watchdog_s=1.0)
    by_suite = {r.suite: {q.outcome for q in rows if q.suite == r.suite} for r in rows}
    assert by_suite["faults"] == {"timeout"}
    assert by_suite["toy"] <= {"success", "horizon"}


def unit(task: str, name: str, trial: int) -> WorkItem:
    base = fake_scenario(0)
    return WorkItem(replace(base, id=f"{task}-{name}", task=replace(base.task, name=task)), trial)


def test_a_slot_stays_with_its_scenario_then_with_its_task():
    queue = WorkQueue([unit(t, n, k) for k in range(2) for n in "ab" for t in ("push-left", "push-right")])
    last, seen = None, []
    while (last := queue.take(last)) is not None:
        seen.append((last.task[1], last.scenario.id))
    changes = sum(a != b for a, b in itertools.pairwise(seen))
    assert changes == 3
    assert len(seen) == 8
    assert sum(a[0] != b[0] for a, b in itertools.pairwise(seen)) == 1


def test_slots_spread_over_tasks():
    queue = WorkQueue([unit(t, "a", k) for t in ("push-left", "push-right") for k in range(3)])
    first = queue.take(None)
    second = queue.take(None, busy=[first.task])
    assert first.task != second.task


@pytest.mark.parametrize("slots", [1, 2, 3, 20])
def test_idle_slots_begin_with_tasks_of_their_own_while_there_are(slots):
    units = [unit(t, n, k) for t in ("push-left", "push-right") for n in "ab" for k in range(3)]
    taken = first_units(units, slots)
    assert len({(u.scenario.id, u.trial) for u in taken}) == len(taken) == min(slots, len(units))
    assert len({u.task for u in taken[:2]}) == min(slots, 2)
    assert first_units([], slots) == []


def test_dropping_a_scenario_takes_its_units_out():
    queue = WorkQueue([unit("push-left", n, k) for n in "ab" for k in range(3)])
    assert len(queue.drop("push-left-a")) == 3
    assert len(queue) == 3
    assert queue.drop("nobody") == []
