"""Trajectories of one scenario replay its prefix once, and look as if each had a replay of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.rendered_steps import (
    GROUPED_LOOKS,
    RenderedSteps,
    RenderJob,
    groups,
    render_steps,
)
from lerobot_roborecover.platforms import Simulator, make_simulator
from lerobot_roborecover.scenario import Scenario
from tests.support.factories import fake_scenario


def some_jobs(scenario: Scenario, lengths: Sequence[int], seed: int) -> list[RenderJob]:
    rng, width = np.random.default_rng(seed), scenario.prefix.shape[1]
    jobs = []
    for length in lengths:
        end = len(scenario.prefix) + length
        steps = np.flatnonzero(rng.random(end) < 0.4)
        jobs.append(RenderJob(scenario, rng.uniform(-1, 1, (length, width)).astype(np.float32), steps))
    return jobs


def assert_alike(found: Sequence[RenderedSteps], wanted: Sequence[RenderedSteps]) -> None:
    for one, other in zip(found, wanted, strict=True):
        assert one.succeeded == other.succeeded
        np.testing.assert_array_equal(one.progress, other.progress)
        for a, b in zip(one.observations, other.observations, strict=True):
            np.testing.assert_equal(a, b)


def check(simulator: Simulator, jobs: Sequence[RenderJob], monkeypatch: pytest.MonkeyPatch) -> None:
    stepped = []
    step = simulator.step
    monkeypatch.setattr(simulator, "step", lambda action: (stepped.append(1), step(action)))
    alone = [found for job in jobs for found in render_steps(simulator, [job])]
    each, prefix = len(stepped), len(jobs[0].scenario.prefix)
    together = render_steps(simulator, jobs)
    # The last step of the prefix is taken again after its snapshot.
    assert len(stepped) - each == each - (len(jobs) - 1) * (prefix - 1)
    assert_alike(together, alone)


def test_together_as_one_by_one(monkeypatch):
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    check(simulator, some_jobs(fake_scenario(3), (5, 0, 12), 0), monkeypatch)


@pytest.mark.slow
@pytest.mark.metaworld
def test_together_as_one_by_one_on_meta_world(monkeypatch):
    simulator = make_simulator("metaworld", obs_type="state")
    scenario = next(iter(load_scenarios("metaworld_starter")))
    check(simulator, some_jobs(scenario, (40, 25), 1), monkeypatch)


def test_where_snapshots_drift_each_is_replayed(monkeypatch):
    simulator = make_simulator("fake")
    monkeypatch.setattr(type(simulator), "snapshot_is_exact", False)
    jobs = some_jobs(fake_scenario(3), (5, 8), 2)
    monkeypatch.setattr(simulator, "restore", None)
    assert_alike(render_steps(simulator, jobs), [render_steps(simulator, [job])[0] for job in jobs])


@given(st.lists(st.tuples(st.integers(0, 2), st.sampled_from([1, 40, 200, 600])), max_size=12))
def test_groups_keep_the_order_and_hold_one_scenario(made):
    scenarios = [object() for _ in range(3)]
    jobs = [RenderJob(scenarios[which], np.empty((0, 2)), np.arange(looks)) for which, looks in made]  # type: ignore[arg-type]
    found = list(groups(jobs))
    assert [job for group in found for job in group] == jobs
    for group in found:
        assert {id(job.scenario) for job in group} == {id(group[0].scenario)}
        assert len(group) == 1 or sum(len(job.steps) for job in group) <= GROUPED_LOOKS
