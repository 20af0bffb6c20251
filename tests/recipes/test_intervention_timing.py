"""The training scenarios' three parts: everything once, what begins alike together, whatever the order."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.split import start_of
from recipes.intervention_timing import PARTS, divide
from tests.support.factories import fake_scenario

SCENARIOS = [fake_scenario(i, steps=3) for i in range(120)]


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(120)), st.integers(1, 40))
def test_what_begins_alike_is_in_one_part(order, starts):
    scenarios = [replace(SCENARIOS[i], reset=replace(SCENARIOS[i].reset, seed=i % starts)) for i in order]
    parts = divide(scenarios)
    assert sorted(i for ids in parts.values() for i in ids) == sorted(s.id for s in scenarios)
    where = {i: part for part, ids in parts.items() for i in ids}
    sides: dict[tuple, set[str]] = {}
    for s in scenarios:
        sides.setdefault(start_of(s), set()).add(where[s.id])
    assert all(len(found) == 1 for found in sides.values())
    assert where == {i: part for part, ids in divide(scenarios[::-1]).items() for i in ids}


def test_shares_are_about_what_they_should_be():
    parts = divide(SCENARIOS)
    assert sum(PARTS.values()) == 1
    for part, share in PARTS.items():
        assert abs(len(parts[part]) / 120 - share) < 0.15
