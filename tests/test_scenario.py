"""A rollout without labels: what it checks, its hash, and the scenario that has one."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

import lerobot_roborecover.rollout as records
from lerobot_roborecover.curation.collect.starts import make_units
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.logs.row import EvalProtocol, make_row
from lerobot_roborecover.platforms.starts import Starts
from lerobot_roborecover.scenario import Outcome, Reset, Rollout, Scenario, ScenarioError, Task

TASK = Task("fake", "toy", "push-left", "push", 60)


def scenario(**changes) -> Scenario:
    """One of a few actions."""
    given = {"id": "a", "task": TASK, "reset": Reset(seed=1), "prefix": np.ones((3, 2))}
    labels = {"stage": "Move", "deviation": "Wrong Pose", "source": "natural"}
    return Scenario(**{**given, **labels, **changes})


def test_a_scenario_has_its_rollout_and_that_decides_its_hash():
    one = scenario()
    assert one.rollout.task is one.task
    assert one.rollout.actions is one.prefix
    assert Rollout(TASK, Reset(seed=1), np.ones((3, 2))).sha256() == one.sha256()
    assert scenario(id="b", split="train", stage="Place").sha256() == one.sha256()
    assert scenario(reset=Reset(seed=2)).sha256() != one.sha256()
    assert replace(one, prefix=np.ones((2, 2))).rollout.actions.shape == (2, 2)


def test_shipped_hashes_are_what_they_were():
    """Of the files: reading compares every scenario's hash with the one that stands there."""
    first = sorted(load_scenarios("metaworld_starter"), key=lambda s: s.id)[0]
    assert first.rollout.sha256() == first.sha256()


def test_the_hash_is_computed_once(monkeypatch):
    one, calls = scenario(), []
    original = records.json.dumps
    monkeypatch.setattr(records.json, "dumps", lambda *a, **k: calls.append(1) or original(*a, **k))
    assert {one.sha256() for _ in range(3)} == {one.rollout.sha256()}
    assert len(calls) == 1
    assert pickle.loads(pickle.dumps(one)).sha256() == one.sha256()
    assert len(calls) == 1


def test_a_pickle_holds_the_actions_once():
    one = scenario(prefix=np.ones((1000, 7)))
    assert len(pickle.dumps(one)) < one.prefix.nbytes + 2000
    back = pickle.loads(pickle.dumps(one))
    assert back.rollout.actions is back.prefix


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.ones(3), "float64 array"),
        (np.ones((3, 2), np.float32), "float32"),
        (np.full((3, 2), np.nan), "action 0, dimension 0 is nan"),
        (np.full((3, 2), 1e9), "the limit is 1000"),
        (np.ones((records.MAX_PREFIX_STEPS + 1, 1)), "20001 actions"),
    ],
)
def test_a_rollout_that_cannot_be_replayed_is_refused(actions, message):
    with pytest.raises(ScenarioError, match=message):
        Rollout(TASK, Reset(), actions)
    with pytest.raises(ScenarioError, match=f"scenario a: .*{message}"):
        scenario(prefix=actions)


def test_what_collect_rolls_out_has_no_labels():
    """A trial can start from it all the same, and its row says nothing of stage and type."""
    (planned,) = make_units([TASK], Starts(seeds=(4,)), "expert", np.zeros(2), perturbed=True)
    assert not isinstance(planned, Scenario)
    assert not hasattr(planned, "stage")
    row = make_row(
        planned, EvalProtocol("recovery", 0, "expert", 1, None), dataset="", dataset_revision=None, trial=0,
        noise="", batch_size=1, outcome=Outcome.HORIZON, reason="", steps=60, handoff=None, sim_s=0.0,
        policy_s=0.0, actions_sha256="",
    )  # fmt: skip
    assert (row.scenario_id, row.stage, row.deviation, row.source) == (planned.id, "", "", "")
    assert row.scenario_sha256 == planned.rollout.sha256()
    twin = replace(planned, twin=True)
    assert (twin.id, twin.record_name, twin.disturbed) == (planned.id, f"{planned.id}.twin", False)
