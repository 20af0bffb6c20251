"""Sequential tests: their error over all looks, their intervals and the order of scenarios."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.analysis.stats.sequential import RateSequence, SequentialTest, grid_of, sequence
from lerobot_roborecover.evaluation.work_items import OrderedQueue, WorkItem
from tests.support.factories import fake_scenario

STEPS = st.lists(st.integers(-5, 5), min_size=1, max_size=40)


def taken(steps, units=None, level=0.95):
    test = SequentialTest(units or len(steps), 5, level)
    for step in steps:
        test.add(step / 5)
    return test


@pytest.mark.parametrize("sizes", [[1] * 11, [1, 2, 3, 1, 2, 5, 4, 3, 2, 1, 1]])
@pytest.mark.parametrize("level", [0.95, pytest.param(0.8, marks=pytest.mark.nightly)])
def test_the_error_over_all_looks_is_exactly_within_the_level(sizes, level):
    """Every pattern of signs is as likely under "the two are alike": so many of them may decide, no more."""
    decided = [
        taken(np.array(signs) * sizes, level=level).decided_after is not None
        for signs in product((-1, 1), repeat=len(sizes))
    ]
    assert 0.4 * (1 - level) < np.mean(decided) <= 1 - level


@settings(max_examples=25)
@given(STEPS, st.integers(0, 30))
def test_decision_and_p_say_the_same(steps, more):
    test = taken(steps, len(steps) + more)
    d = test.difference
    if test.decided_after is not None:
        assert test.p <= 0.05 + 1e-6
    elif more:
        assert test.p == 1
    else:
        assert test.p > 0.05 - 1e-6
    assert -1 <= d.low <= d.value <= d.high <= 1


def test_p_is_one_on_every_level():
    """Of all patterns of signs, no more than a share u has a p of at most u."""
    sizes = [1, 2, 3, 1, 2, 5, 4, 3, 2, 1]
    p = np.array([taken(np.array(signs) * sizes).p for signs in product((-1, 1), repeat=len(sizes))])
    for u in (0.005, 0.02, 0.05, 0.2, 0.5):
        assert np.mean(p <= u + 1e-12) <= u


def test_what_comes_after_the_decision_counts_no_more():
    test = taken([5] * 20, 40)
    assert test.decided_after is not None
    assert test.decided_after < 20
    assert len(test.steps) == test.decided_after
    assert taken([5] * 20 + [-5] * 20, 40).difference == test.difference


def test_looking_every_time_with_a_fixed_test_would_be_wrong():
    """What the sequential test is for: a fixed-n test at every look errs far more often than it says."""
    from lerobot_roborecover.analysis.stats.permutation import sign_flip_p

    rng = np.random.default_rng(0)
    walks = rng.integers(0, 2, (150, 40)) * 2 - 1
    peeked = np.mean([any(sign_flip_p(w[:n]) < 0.05 for n in range(6, 41)) for w in walks])
    assert peeked > 0.09
    assert np.mean([taken(w).decided_after is not None for w in walks]) < 0.06


def test_the_differences_interval_holds_where_few_scenarios_differ():
    """Of rates of .02 and .1 the first scenarios mostly show no difference at all."""
    rng, held = np.random.default_rng(0), []
    for _ in range(40):
        test = SequentialTest(40, 1)
        for a, b in zip(rng.binomial(1, 0.1, 40), rng.binomial(1, 0.02, 40), strict=True):
            test.add(float(a - b))
        held.append(test.difference.low <= 0.08 <= test.difference.high)
    assert np.mean(held) >= 0.9


def test_a_rates_confidence_sequence_holds_at_every_time_at_once():
    rng, held = np.random.default_rng(0), []
    for _ in range(60):
        found, kept = RateSequence(), True
        for value in rng.binomial(1, 0.3, 40):
            found.add(float(value))
            kept &= found.estimate.low <= 0.3 <= found.estimate.high
        held.append(kept)
    assert np.mean(held) >= 0.93
    for value, edge in ((0.0, "low"), (1.0, "high")):
        all_alike = RateSequence()
        for _ in range(50):
            all_alike.add(value)
        assert getattr(all_alike.estimate, edge) == value
        assert all_alike.estimate.high - all_alike.estimate.low < 0.15


def test_the_order_is_no_order_of_the_set_and_that_of_a_part_is_its_part():
    names = [f"scenario:task-{n // 10}-{n % 10}" for n in range(60)]
    order = sequence(names)
    assert sorted(order) == names != order
    assert sequence(reversed(names[:30])) == [n for n in order if n in names[:30]]
    tasks = [n.split("-")[1] for n in order[:10]]
    assert len(set(tasks)) > 3


def test_trial_counts_decide_the_grid():
    assert grid_of([5, 2]) == 10
    assert grid_of([7, 9, 10]) == 120


def test_units_come_in_the_order_given():
    units = [WorkItem(fake_scenario(n), k) for n in (2, 0, 1) for k in range(2)]
    queue = OrderedQueue(units)
    assert [queue.take(units[-1]) for _ in range(2)] == units[:2]
    queue.put_back(units[1])
    assert len(queue) == 5
    assert queue.drop(units[2].scenario.id) == units[2:4]
    assert [queue.take(None) for _ in range(4)] == [units[1], *units[4:], None]
