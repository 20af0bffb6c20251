"""Every shipped scenario hands off exactly: to the last bit as a fresh process of this machine does, whatever
came before, and as it was recorded (see `exactness`). By default a few of each set; with --nightly all.
"""

from __future__ import annotations

import random
from collections import Counter
from functools import cache

import pytest

from lerobot_roborecover import load_scenarios
from lerobot_roborecover.datasets.load import builtin_names, validate_for
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off
from lerobot_roborecover.scenario import Start
from tests.support.exactness import PINNED, as_recorded, states_in_a_fresh_process

load = cache(load_scenarios)

SETS = [
    pytest.param("metaworld_starter", marks=pytest.mark.metaworld),
    pytest.param("libero_starter", marks=[pytest.mark.libero, pytest.mark.slow, pytest.mark.nightly]),
]
FEW = [
    pytest.param("metaworld_starter", 4, marks=pytest.mark.metaworld),
    pytest.param("metaworld_study", 3, marks=[pytest.mark.metaworld, pytest.mark.nightly]),
    pytest.param("metaworld_recovery", 3, marks=pytest.mark.metaworld),
    pytest.param("libero_starter", 3, marks=[pytest.mark.libero, pytest.mark.slow, pytest.mark.nightly]),
    pytest.param("libero_recovery", 3, marks=[pytest.mark.libero, pytest.mark.slow]),
    pytest.param("pusht_starter", 4, marks=pytest.mark.slow),
]
"""Sets, and how many scenarios the default run takes of each."""
LIBERO_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
WHOLE = [
    pytest.param("metaworld_starter", "", marks=pytest.mark.metaworld),
    pytest.param("metaworld_study", "", marks=pytest.mark.metaworld),
    pytest.param("metaworld_recovery", "", marks=pytest.mark.metaworld),
    pytest.param("pusht_starter", ""),
    *(
        pytest.param(name, f"suite={s}", marks=pytest.mark.libero)
        for name in ("libero_starter", "libero_recovery", "libero_recovery_0")
        for s in LIBERO_SUITES
    ),
]


STRAY = {"metaworld_starter": 0, "libero_starter": 0 if PINNED else 1}
"""Scenarios whose handoff may be refused, with other kernels than those of the recording: measured."""


@pytest.mark.parametrize("name", builtin_names())
def test_every_shipped_state_has_its_hash(name):
    """Without it no handoff can be known to be the recorded one, bit for bit."""
    found = load(name)
    assert len(found) > 0
    assert [s.id for s in found if s.fingerprint is None or not s.fingerprint.state_sha256] == []
    assert all(s.fingerprint.versions for s in found)


@pytest.mark.parametrize("name", builtin_names())
def test_no_two_scenarios_are_one_moment(name):
    moments = [s.sha256() for s in load(name)]
    assert len(set(moments)) == len(moments)


@pytest.mark.parametrize(("name", "count"), FEW)
def test_a_few_scenarios_by_replay_and_by_snapshot(name, count):
    scenarios = sorted(load(name), key=lambda s: len(s.prefix))
    # Two of one task, so that one follows another in the same model, and the others of any.
    first = scenarios[0]
    twin = next(s for s in scenarios[1:] if s.task.name == first.task.name)
    rest = [s for s in scenarios if s not in (first, twin)]
    few = [first, twin, *(rest[i * len(rest) // (2 * count)] for i in range(count - 2))]
    by_replay_and_by_snapshot(name, few, fresh_every=count - 1)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize(("name", "select"), WHOLE)
def test_every_scenario_by_replay_and_by_snapshot(name, select):
    by_replay_and_by_snapshot(name, list(load_scenarios(name, select=select)), fresh_every=3)


def by_replay_and_by_snapshot(name, scenarios, fresh_every):
    platform = scenarios[0].platform
    # Grouped by task, so that models compile once, but in an order of its own within and between tasks.
    rng = random.Random(1)
    tasks = {s.task.name: rng.random() for s in scenarios}
    order = sorted(scenarios, key=lambda s: (tasks[s.task.name], rng.random()))
    simulator, cache = make_simulator(platform, obs_type="state"), SnapshotCache()
    states, strayed = {}, []
    for scenario in order:
        replayed = hand_off(simulator, scenario, cache=cache)
        if not as_recorded(scenario, replayed):
            strayed.append((scenario.id, replayed))
        assert not replayed.from_snapshot
        restored = hand_off(simulator, scenario, cache=cache)
        assert restored.state_sha256 == replayed.state_sha256, (scenario.id, restored)
        assert restored.from_snapshot == simulator.snapshot_is_exact
        states[scenario.id] = replayed.state_sha256
    simulator.close()
    assert len(strayed) <= STRAY.get(name, 0), strayed
    # Some of them, the last first: other ones come before each than did here.
    fresh = states_in_a_fresh_process(name, [s.id for s in reversed(order)][::fresh_every])
    assert fresh == {i: states[i] for i in fresh}


@pytest.mark.parametrize("name", SETS)
def test_other_starts_other_seeds_and_other_tasks_leave_no_trace(name):
    from dataclasses import replace

    scenarios = list(load_scenarios(name))
    first = scenarios[0]
    other = next(s for s in scenarios if s.task.name != first.task.name)
    simulator = make_simulator(first.platform, obs_type="state")
    alone = states_in_a_fresh_process(name, [first.id])[first.id]
    assert hand_off(simulator, first).state_sha256 == alone
    hand_off(simulator, other, Start.INITIAL)
    hand_off(simulator, replace(first, reset=replace(first.reset, seed=12345), fingerprint=None))
    assert hand_off(simulator, first).state_sha256 == alone
    hand_off(simulator, first, Start.REVERSION, rewind_steps=7)
    assert hand_off(simulator, first).state_sha256 == alone
    simulator.close()


@pytest.mark.render
@pytest.mark.nightly
@pytest.mark.parametrize("name", SETS)
def test_rendering_changes_nothing(name):
    scenario = load_scenarios(name)[1]
    simulator = make_simulator(scenario.platform, observation_height=64, observation_width=64)
    simulator.reset(scenario.task, scenario.reset)
    for step, action in enumerate(scenario.prefix):
        if step % 10 == 0:
            simulator.observe()
        simulator.step(action)
    simulator.observe()
    assert simulator.state_sha256() == states_in_a_fresh_process(name, [scenario.id])[scenario.id]
    simulator.close()


def test_what_the_metaworld_set_promises():
    scenarios = load_scenarios("metaworld_starter")
    validate_for(scenarios, "metaworld")
    assert len(scenarios) >= 24
    assert len({s.task.name for s in scenarios}) >= 8
    assert len({s.cell for s in scenarios}) >= 6
    assert len({s.source for s in scenarios}) >= 2


def test_what_the_libero_set_promises():
    scenarios = load_scenarios("libero_starter")
    validate_for(scenarios, "libero")
    assert len(scenarios) >= 24
    suites = Counter(s.task.suite for s in scenarios)
    assert set(suites) == {"libero_spatial", "libero_object", "libero_goal", "libero_10"}
    horizons = {s.task.suite: s.task.horizon for s in scenarios}
    assert horizons == {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520}
    assert all(s.reset.settle_steps == 10 and s.reset.fixtures is not None for s in scenarios)


@pytest.mark.parametrize("name", ["metaworld_starter", "libero_starter"])
def test_every_scenario_carries_its_proof_of_recoverability(name):
    for scenario in load_scenarios(name):
        assert scenario.provenance.get("proof"), scenario.id
