"""The engine keeps simulators and policy busy: its schedule, on a clock that no load disturbs."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.env.run import Run
from lerobot_roborecover.env.trial_row import Protocol
from lerobot_roborecover.policies.host import InlineReplica
from lerobot_roborecover.trials.engine import Engine, units_of
from lerobot_roborecover.trials.sizes import available_gb, default_slots, usable_cores
from tests.support.factories import fake_scenario
from tests.support.virtual_time import VirtualHost, VirtualSlot, World

STEP_S = 0.011
CHUNK = 10


def schedule(slots: int, cores: int, fixed_s: float, each_s: float = 0.0, shortest: int = 100):
    """Twelve trials per slot, horizons from `shortest` to 100; the world and the policy afterwards."""
    world = World(cores, STEP_S, jitter=0.03)
    host = VirtualHost(world, fixed_s, each_s, CHUNK)
    rng, base = np.random.default_rng(0), fake_scenario(0)
    scenarios = [
        replace(
            base, id=f"s{k}", fingerprint=None,
            task=replace(base.task, horizon=int(rng.integers(shortest, 101))),
        )
        for k in range(slots)
    ]  # fmt: skip
    run = Run(None, Protocol("recovery", 0, "p", 0, CHUNK), None, "d", None)
    seats = [VirtualSlot(world) for _ in range(slots)]
    engine = Engine(run, seats, [InlineReplica(host)], world.wait, clock=world.clock)
    assert engine.run(units_of(scenarios, 12)) == slots * 12
    return world, host


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


def test_more_slots_than_cores_pay_under_a_slow_policy():
    rates = {}
    for slots in (8, 16):
        world, host = schedule(slots, 8, 0.1)
        rates[slots] = sum(host.batches) / world.now
    assert rates[16] > 1.7 * rates[8]


def test_a_fast_policy_is_not_waited_for():
    """Company is worth waiting for by what an inference takes."""
    world, _ = schedule(8, 8, 0.002)
    assert world.now < 1.1 * (world.core_s / 8 + 12 * CHUNK * 0.010)


def test_the_first_inference_which_compiles_makes_nobody_patient():
    world = World(4, STEP_S)
    host = VirtualHost(world, 0.01, chunk=CHUNK)
    run = Run(None, Protocol("recovery", 0, "p", 0, CHUNK), None, "d", None)
    replica = InlineReplica(host)
    engine = Engine(run, [VirtualSlot(world)], [replica], world.wait, clock=world.clock)
    engine._inference_s[replica].append(60.0)
    assert engine._delay(replica) <= 0.25
    engine._inference_s[replica].append(0.01)
    assert engine._delay(replica) == pytest.approx(0.01)


def test_default_slots_follow_cores_memory_and_the_policys_device(tmp_path):
    assert default_slots("cpu", 16, 1000.0) == 16
    assert default_slots("cuda", 16, 1000.0) == 32
    assert default_slots("cuda:1", 16, 30.0) == 20
    assert default_slots("cuda", 16, 8.0) == 16, "one a core is the caller's own choice to lower"
    assert usable_cores() == len(os.sched_getaffinity(0))
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal:       24000000 kB\nMemAvailable:    3145728 kB\n")
    assert available_gb(meminfo) == 3.0
    assert available_gb(tmp_path / "none") == float("inf")
