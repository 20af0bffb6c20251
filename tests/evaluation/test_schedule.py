"""The engine keeps simulators and policy busy: its schedule, on a clock that no load disturbs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lerobot_roborecover.evaluation.batching import BatchTimer
from lerobot_roborecover.evaluation.scheduler import Engine
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.row import EvalProtocol
from lerobot_roborecover.policies.runner import InlineReplica
from lerobot_roborecover.workers.capacity import default_slots
from tests.support.factories import fake_scenario
from tests.support.virtual_time import VirtualHost, VirtualSlot, World

STEP_S = 0.011
CHUNK = 10


def schedule(
    slots: int,
    cores: int,
    fixed_s: float,
    each_s: float = 0.0,
    shortest: int = 100,
    *,
    chunk: int = CHUNK,
    trials: int = 12,
    limit: int = 64,
):
    """Trials of every slot, horizons from `shortest` to 100; the world and the policy afterwards."""
    world = World(cores, STEP_S, jitter=0.03)
    host = VirtualHost(world, fixed_s, each_s, chunk, limit)
    rng, base = np.random.default_rng(0), fake_scenario(0)
    scenarios = [
        replace(
            base, id=f"s{k}", fingerprint=None,
            task=replace(base.task, horizon=int(rng.integers(shortest, 101))),
        )
        for k in range(slots)
    ]  # fmt: skip
    run = EvalSession(None, EvalProtocol("recovery", 0, "p", 0, chunk), None, "d", None)
    workers = [VirtualSlot(world) for _ in range(slots)]
    engine = Engine(run, workers, [InlineReplica(host)], world.wait, clock=world.clock)
    assert engine.run(units_of(scenarios, trials)) == slots * trials
    return world, host


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slots", "fixed_s", "each_s", "shortest"),
    [(16, 0.1, 0.0, 100), (16, 0.02, 0.01, 100), (16, 0.05, 0.0, 20), (24, 0.1, 0.0, 20)],
)
def test_several_slots_a_core_come_within_a_tenth_of_the_bound(slots, fixed_s, each_s, shortest):
    """max(simulator time / cores, policy time): nothing can be faster with these batches. Where both take as
    long, and trials differ in length, it takes a third slot a core to even that out."""
    world, host = schedule(slots, 8, fixed_s, each_s, shortest)
    assert world.now < 1.1 * max(world.core_s / 8, host.busy_s)


@pytest.mark.parametrize("shortest", [100, 20])
def test_one_slot_a_core_comes_within_a_tenth_of_its_own_bound(shortest):
    """A slot cannot step while it is inferred for: each of its chunks takes simulation plus inference."""
    world, host = schedule(8, 8, 0.1, shortest=shortest)
    chain = world.core_s / 8 + 0.1 * sum(host.batches) / 8
    assert world.now < 1.1 * chain


@pytest.mark.slow
def test_more_slots_than_cores_pay_under_a_slow_policy():
    rates = {}
    for slots in (8, 16):
        world, host = schedule(slots, 8, 0.1)
        rates[slots] = sum(host.batches) / world.now
    assert rates[16] > 1.7 * rates[8]


def test_a_fast_policy_is_not_waited_for():
    """Others are worth waiting for by what an inference takes."""
    world, _ = schedule(8, 8, 0.002)
    assert world.now < 1.1 * (world.core_s / 8 + 12 * CHUNK * 0.010)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fixed_s", "each_s", "limit"), [(0.1, 0.0, 64), (0.07, 0.005, 64), (0.07, 0.005, 16)]
)
def test_where_an_inference_costs_more_than_simulation_all_are_asked_about_together(fixed_s, each_s, limit):
    world, host = schedule(16, 16, fixed_s, each_s, chunk=1, trials=2, limit=limit)
    rounds = sum(host.batches) / 16
    together = rounds * (STEP_S + fixed_s + 16 * each_s)
    assert world.now < 1.1 * together
    assert together < 0.8 * rounds * 2 * (fixed_s + 8 * each_s), "two halves that take turns"


def test_a_batch_that_cannot_hold_all_is_not_waited_for_longer():
    """Four of sixteen at a time: an inference begins as soon as four wait."""
    world, host = schedule(16, 16, 0.1, chunk=1, trials=2, limit=4)
    assert np.mean(host.batches) > 3.9
    assert host.busy_s > 0.98 * world.now


def _timer(fixed_s: float, each_s: float, simulation_s: float) -> BatchTimer:
    """One that has seen inferences for four and for eight of eight."""
    timer = BatchTimer(0.01)
    for batch in (4, 8, 4, 8):
        timer.inferred(batch, fixed_s + batch * each_s)
        timer.simulated(8, simulation_s)
    return timer


@given(
    st.floats(0.001, 2), st.floats(0, 0.2), st.floats(0.001, 4), st.integers(1, 7),
)  # fmt: skip
def test_others_are_waited_for_where_an_inference_costs_more_than_it(fixed_s, each_s, simulation_s, waiting):
    assume(abs(fixed_s - simulation_s) > 1e-3 * fixed_s)
    timer = _timer(fixed_s, each_s, simulation_s)
    at = timer.ask_at([10.0] * waiting, [10.0] * (8 - waiting), 0, 64)
    if simulation_s < fixed_s:
        assert at == pytest.approx(10 + simulation_s + 0.01)
    else:
        assert at == (10.0 if waiting >= 4 else 10 + timer.delay_s)


def test_a_simulator_that_hangs_is_not_waited_for():
    timer = _timer(1.0, 0.0, 0.5)
    assert timer.ask_at([30.0] * 7, [10.0], 0, 64) == pytest.approx(10.51), "long ago"
    assert timer.ask_at([30.0] * 7, [], 1, 64) == 30, "nor one that rebuilds a start"


def test_before_batches_differ_all_are_asked_about_together_once():
    timer = BatchTimer(0.01)
    for _ in range(3):
        timer.inferred(4, 1.0)
        timer.simulated(4, 0.2)
    assert timer.ask_at([10.0] * 4, [10.0] * 4, 0, 64) == pytest.approx(10.41), "the cores may be shared"
    for _ in range(2):
        timer.inferred(8, 1.9)  # an observation more is what costs
    assert timer.ask_at([10.0] * 4, [10.0] * 4, 0, 64) == 10


def test_the_first_inference_which_compiles_makes_nobody_patient():
    timer = BatchTimer(0.01)
    timer.inferred(1, 60.0)
    assert timer.delay_s <= 0.25
    timer.inferred(1, 0.01)
    assert timer.delay_s == pytest.approx(0.01)


def test_default_slots_follow_cores_memory_and_the_policys_device():
    assert default_slots("cpu", 16, 1000.0) == 16
    assert default_slots("cuda", 16, 1000.0) == 32
    assert default_slots("cuda:1", 16, 30.0) == 20
    assert default_slots("cuda", 16, 8.0) == 5
    assert default_slots("cpu", 16, 8.0) == 5, "a policy on the CPU makes no simulator smaller"
    assert default_slots("cpu", 16, 0.1) == 1
    assert default_slots("cpu", 16, float("inf")) == 16
