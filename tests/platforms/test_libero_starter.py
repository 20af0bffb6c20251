"""The shipped LIBERO starter set: what it promises, and that its handoffs are exact."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import lerobot_roborecover
from lerobot_roborecover.datasets import read_scenarios
from lerobot_roborecover.platforms.libero import PLATFORM
from lerobot_roborecover.platforms.libero.catalog import LIBERO_HORIZONS
from lerobot_roborecover.replay.handoff import SnapshotCache, hand_off
from lerobot_roborecover.scenario import Reset, Scenario, Source
from tests.support.exactness import as_recorded

FOLDER = Path(lerobot_roborecover.__file__).parent / "data" / "libero_starter"


@pytest.fixture(scope="module")
def scenarios() -> list[Scenario]:
    return read_scenarios(FOLDER)


def test_set_is_what_it_promises(scenarios):
    assert len(scenarios) >= 24
    assert {s.task.suite for s in scenarios} == set(LIBERO_HORIZONS)
    assert len({s.cell for s in scenarios}) >= 5
    sources = Counter(s.source for s in scenarios)
    assert sources[Source.NATURAL] >= 8
    assert sources[Source.PERTURBED] >= 8
    size = sum(f.stat().st_size for f in FOLDER.rglob("*") if f.is_file())
    assert size < 1_000_000
    for s in scenarios:
        PLATFORM.check_task(s.task)
        assert s.task.horizon == LIBERO_HORIZONS[s.task.suite]
        assert s.reset.seed == 7
        assert s.reset.settle_steps == 10
        assert np.array_equal(s.prefix[:10], np.tile([0, 0, 0, 0, 0, 0, -1.0], (10, 1)))
        assert not np.array_equal(s.prefix[10], s.prefix[9])
        assert s.fingerprint.state_sha256
        assert set(s.fingerprint.versions) == {"mujoco", "robosuite", "hf-libero", "libero_assets"}
        assert 1 <= s.provenance["proof"]["steps"] <= s.task.horizon
        noisy = s.provenance["perturbed_steps"]
        assert (noisy > 0) == (s.source is Source.PERTURBED)
        assert s.provenance["failure_lasts_steps"] >= 30


def test_perturbed_prefixes_are_not_clipped(scenarios):
    perturbed = [s for s in scenarios if s.source is Source.PERTURBED]
    assert all(np.abs(s.prefix[:, :3]).max() > 1.0 for s in perturbed)


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_handoffs_are_identical_by_replay_and_by_snapshot(scenarios, simulator):
    """In a process that did not make them, in either order, after other tasks and seeds."""
    sampled = list({s.task.suite: s for s in scenarios}.values())  # the last of each suite
    cache = SnapshotCache()
    states = {}
    for s in sampled:
        simulator.reset(sampled[0].task, Reset(seed=3, init_state_index=1))
        handoff = hand_off(simulator, s, cache=cache)
        assert as_recorded(s, handoff), (s.id, handoff)
        assert not handoff.from_snapshot
        states[s.id] = handoff.state_sha256
    for s in reversed(sampled):
        handoff = hand_off(simulator, s, cache=cache)
        assert (handoff.state_sha256, handoff.from_snapshot) == (states[s.id], True), s.id


@pytest.mark.nightly
@pytest.mark.libero
@pytest.mark.slow
def test_a_recipe_makes_its_scenario_again(scenarios, simulator):
    from recipes.libero.recipes import RECIPES
    from recipes.libero.starter import digest, prove, roll_out

    assert [r.id for r in RECIPES] == [s.id for s in scenarios]
    assert [digest(r) for r in RECIPES] == [s.provenance["recipe"] for s in scenarios]
    recipe = min(RECIPES, key=lambda r: r.step)
    shipped = next(s for s in scenarios if s.id == recipe.id)
    again = roll_out(simulator, recipe, steps=recipe.step - 10)
    # The controller looks at where things are: another processor rounds otherwise (see `exactness`).
    np.testing.assert_allclose(again.rollout.actions, shipped.prefix, rtol=0, atol=1e-6)
    assert prove(simulator, shipped) == shipped.provenance["proof"]["steps"]


def test_marks_are_not_among_what_moved():
    from lerobot_roborecover.replay.recorder import Steps
    from recipes.libero.recipes import RECIPES
    from recipes.libero.starter import _provenance

    recipe = RECIPES[0]
    path = np.zeros((recipe.step + 1, 7))
    path[-1, 0] = 0.1
    bodies = dict.fromkeys(("eef", "plate_1_main", "bowl_1_main.goal"), path)
    count = recipe.step
    seen = Steps(bodies, np.zeros(count + 1, bool), np.zeros(count, np.int8))
    assert _provenance(recipe, seen, 5)["moved_m"] == {"plate_1_main": 0.1}
