"""Pictures through shared memory and through pipes: the policy sees the same, bit for bit."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch):
    """On the path for one test: numba asks for the library `coverage`, and the folder has a namesake."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))


@pytest.mark.nightly
@pytest.mark.slow
def test_both_ways_show_the_same():
    from observed_steps import measure

    args = Namespace(slots=2, size=64, steps=20, trials=2)
    found = [measure(memory, args, hashed=True) for memory in (True, False)]
    assert found[0]["steps"] == found[1]["steps"] > 20
    assert found[0]["seen"] == found[1]["seen"], "whichever slot had which trial"
    assert len(set(found[0]["seen"])) > 10, "the pictures change"
