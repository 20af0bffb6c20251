"""Choosing scenarios: the selection language, shards, look-up by id, and the check against a platform."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_roborecover.datasets.load import ScenarioSet, validate_for
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task


def scenario(
    id: str,
    suite: str = "libero_goal",
    task: str = "open_the_middle_drawer_of_the_cabinet",
    stage: str = "Approach",
    deviation: str = "Wrong Pose",
    source: str = "natural",
    policy: str = "pi05",
    split: str = "test",
) -> Scenario:
    prefix = np.zeros((1, 7))
    task = Task("libero", suite, task, "do it", 300)
    return Scenario(id, task, Reset(), prefix, stage, deviation, source, policy, split)


@pytest.fixture(scope="module")
def few():
    """Six scenarios that differ in every key."""
    return as_set(
        [
            scenario("a1"),
            scenario("a2", stage="Place", deviation="Wrong Target", policy="smolvla"),
            scenario("b1", suite="libero_10", task="t1", source="perturbed"),
            scenario("b2", suite="libero_10", task="t2", source="perturbed", split="train"),
            scenario(
                "c1", suite="libero_object", task="t3", deviation="Scene Change", source="human", policy=""
            ),
            scenario("c2", suite="libero_object", task="t3", stage="Move"),
        ]
    )


def as_set(scenarios) -> ScenarioSet:
    return ScenarioSet(tuple(scenarios), "memory", None, {"platform": "libero"})


@pytest.mark.parametrize(
    ("expression", "ids"),
    [
        ("", "a1 a2 b1 b2 c1 c2"),
        ("   ", "a1 a2 b1 b2 c1 c2"),
        ("id=a1|c2", "a1 c2"),
        ("id=c2|a1", "a1 c2"),
        ("suite=libero_goal|libero_10", "a1 a2 b1 b2"),
        ("suite=libero_*", "a1 a2 b1 b2 c1 c2"),
        ("task=t?", "b1 b2 c1 c2"),
        ("task=t[12]", "b1 b2"),
        ("stage=Approach", "a1 b1 b2 c1"),
        ("type=Wrong *", "a1 a2 b1 b2 c2"),
        ("cell=Approach-*", "a1 b1 b2 c1"),
        ("cell=Place-Wrong Target", "a2"),
        ("source=human", "c1"),
        ("policy=smolvla", "a2"),
        ("split=train", "b2"),
        (" suite = libero_goal | libero_10 ;source=perturbed; split=test ", "b1"),
    ],
)
def test_an_expression_selects_in_the_set_s_order(few, expression, ids):
    assert " ".join(few.select(expression).ids) == ids


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("colour=red", ["unknown key 'colour'", "id, suite, task, stage, type, cell, source, policy, split"]),
        ("suite=libero_goal;", ["term 2 is ''"]),
        (";", ["term 1 is ''"]),
        ("suite", ["term 1 is 'suite'", "key=value"]),
        ("suite=", ["term 1 is 'suite='"]),
        ("suite=a||b", ["term 1"]),
        ("=x", ["term 1 is '=x'"]),
        ("suite=libero_gaol", ["suite=libero_gaol matches none of 6", "libero_goal (2)", "libero_10 (2)"]),
        ("suite=libero_goal|libero_gaol", ["suite=libero_gaol matches none"]),
        ("suite=Libero_goal", ["matches none"]),
        (
            "suite=libero_goal; source=human",
            ["is empty", "suite: libero_goal (2)", "source: natural (3)", "human (1)"],
        ),
    ],
)
def test_a_selection_that_cannot_be_meant_says_what_there_is(few, expression, words):
    with pytest.raises(ScenarioError) as caught:
        few.select(expression)
    assert all(word in str(caught.value) for word in (repr(expression), *words)), str(caught.value)


def test_a_long_list_of_values_is_cut(few):
    many = as_set(scenario(f"s{i}") for i in range(500))
    with pytest.raises(ScenarioError, match=r"and 480 more") as caught:
        many.select("id=zzz")
    assert len(str(caught.value)) < 600


@given(st.lists(st.sampled_from("abcd"), min_size=1, max_size=40), st.integers(1, 50))
def test_shards_are_balanced_disjoint_and_complete(tasks, n):
    whole = as_set(scenario(f"s{i}", task=task) for i, task in enumerate(tasks))
    parts = [whole.shard(k, n) for k in range(n)]
    assert Counter(i for part in parts for i in part.ids) == Counter(whole.ids)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert [p.ids for p in parts] == [whole.shard(k, n).ids for k in range(n)]
    # Contiguous runs of tasks: each cut between parts splits at most one task.
    assert sum(len({s.task.name for s in part}) for part in parts) <= len(set(tasks)) + n - 1
    order = {id: i for i, id in enumerate(whole.ids)}
    assert all([order[i] for i in part.ids] == sorted(order[i] for i in part.ids) for part in parts)


@pytest.mark.parametrize(("k", "n"), [(4, 4), (-1, 4), (0, 0)])
def test_a_shard_that_does_not_exist_is_refused(few, k, n):
    with pytest.raises(ScenarioError, match=f"shard {k}/{n}"):
        few.shard(k, n)


def test_a_set_is_a_sequence_that_also_finds_by_id(few):
    assert len(few) == 6
    assert few[0].id == "a1"
    assert few[-1] is few["c2"]
    assert few[1:3].ids == ("a2", "b1")
    assert few[1:3].source == few.source
    assert "b1" in few
    assert few[0] in few
    assert "zz" not in few
    assert replace(few[0], stage="Move") not in few
    with pytest.raises(KeyError):
        few["zz"]


def test_a_platform_mismatch_names_the_env_type_to_use(few):
    with pytest.raises(ScenarioError) as caught:
        validate_for(few, "metaworld")
    assert "roborecover_metaworld" in str(caught.value)
    assert "--env.type=roborecover_libero" in str(caught.value)


def test_nothing_to_run_is_refused():
    with pytest.raises(ScenarioError, match="no scenarios"):
        validate_for([], "libero")


def metaworld(suite: str, name: str) -> Scenario:
    return replace(scenario("m1"), task=Task("metaworld", suite, name, "do it", 300), prefix=np.zeros((1, 4)))


def test_known_tasks_pass_and_unknown_ones_are_refused_before_any_simulator_starts():
    validate_for([metaworld("easy", "button-press-v3")], "metaworld")
    for bad, words in (
        (metaworld("easy", "button-pres-v3"), ["m1", "button-pres-v3", "button-press-v3"]),
        (metaworld("trivial", "button-press-v3"), ["m1", "no suite 'trivial'", "easy"]),
    ):
        with pytest.raises(ScenarioError) as caught:
            validate_for([metaworld("easy", "button-press-v3"), bad], "metaworld")
        assert all(word in str(caught.value) for word in words), str(caught.value)
