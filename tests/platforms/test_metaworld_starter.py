"""The shipped Meta-World set and policy: what they promise, and that every handoff is exact."""

from __future__ import annotations

import json
from collections import Counter
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off
from lerobot_roborecover.scenario import Start
from tests.support.exactness import as_recorded

pytestmark = pytest.mark.metaworld

DATA = Path(str(files("lerobot_roborecover"))) / "data"
SET, POLICY = DATA / "metaworld_starter", DATA / "metaworld_act"


@pytest.fixture(scope="module")
def shipped():
    return list(read_scenarios(SET))


def test_the_set_is_broad_proven_and_small(shipped):
    assert len(shipped) >= 24
    assert len({s.task.name for s in shipped}) >= 8
    assert len({s.cell for s in shipped}) >= 6
    assert {s.source.value for s in shipped} == {"natural", "perturbed"}
    assert {s.split for s in shipped} == {"test"}
    assert len({s.cluster for s in shipped}) == len(shipped)
    for scenario in shipped:
        proof = scenario.provenance["proof"]
        assert proof, scenario.id
        assert all(0 < steps <= scenario.task.horizon for steps in proof.values())
    size = sum(
        path.stat().st_size for folder in (SET, POLICY) for path in folder.rglob("*") if path.is_file()
    )
    assert size < 10e6
    assert max(Counter(s.task.name for s in shipped).values()) <= len(shipped) / 4


@pytest.mark.nightly
def test_every_handoff_is_identical_after_the_others(shipped):
    simulator = make_simulator("metaworld", obs_type="state")
    cache = SnapshotCache()
    states = {}
    for expected_snapshot in (False, True):
        for scenario in shipped:
            handoff = hand_off(simulator, scenario, cache=cache)
            assert as_recorded(scenario, handoff), (scenario.id, handoff)
            assert states.setdefault(scenario.id, handoff.state_sha256) == handoff.state_sha256, scenario.id
            assert handoff.from_snapshot is expected_snapshot
            assert hand_off(simulator, scenario, Start.INITIAL).problem is None
    simulator.close()


@pytest.mark.nightly
def test_a_recorded_proof_still_recovers(shipped):
    """One scenario per proving controller; the others differ in nothing but the seed."""
    from lerobot_roborecover.platforms.metaworld.experts import expert, patient_expert

    simulator = make_simulator("metaworld", obs_type="state")
    seen = set()
    for scenario in shipped:
        controller, steps = next(iter(scenario.provenance["proof"].items()))
        if controller in seen:
            continue
        seen.add(controller)
        hand_off(simulator, scenario)
        name, _, seed = controller.partition("/")
        rng = np.random.default_rng(int(seed or 0))
        act = expert(simulator, scenario.task.name)
        if name == "patient_expert":
            act = patient_expert(simulator, scenario.task.name, rng)
        for t in range(steps):
            assert not simulator.succeeded()
            simulator.step(act(t))
        assert simulator.succeeded(), scenario.id
    simulator.close()


@pytest.mark.lerobot
@pytest.mark.slow
def test_the_policy_loads_as_lerobot_eval_loads_it_and_solves_a_clean_start():
    from lerobot_roborecover.platforms.metaworld import PLATFORM
    from lerobot_roborecover.scenario import Reset
    from recipes.learned import LearnedPolicy

    steps = json.loads((POLICY / "policy_preprocessor.json").read_text())["steps"]
    assert {"device_processor", "rename_observations_processor"} <= {step["registry_name"] for step in steps}
    simulator = make_simulator("metaworld", obs_type="state")
    task = PLATFORM.task("push-v3")
    simulator.reset(task, Reset(seed=0))
    act = LearnedPolicy(simulator, task, str(POLICY))
    for t in range(150):
        simulator.step(act(t))
        if simulator.succeeded():
            break
    assert simulator.succeeded()
