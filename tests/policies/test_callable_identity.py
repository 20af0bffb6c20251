"""The hash of a callable policy: what changes it, what does not, and what cannot be hashed."""

from __future__ import annotations

import functools
import importlib
import random
import threading
from abc import ABC
from dataclasses import dataclass

import numpy as np
import pytest

pytestmark = pytest.mark.lerobot

GAIN = 2.0


def helper(x):
    return GAIN * x


def uses_a_helper(observation, instruction):
    return helper(observation["agent_pos"][:2])


def with_closure(gain):
    return lambda observation, instruction: gain * observation["agent_pos"][:2]


def with_default(observation, instruction, gain=(1.0, 1.0)):
    return gain


class Counter(ABC):  # noqa: B024 - its own members are what counts
    step = 0.5

    def __init__(self, gain=1.0):
        self.gain = gain

    def __call__(self, observation, instruction):
        return helper(self.gain) * self.step


@dataclass(slots=True)
class Slotted:
    gain: float

    def __call__(self, observation, instruction):
        return self.gain


def hashed(policy) -> str:
    from lerobot_roborecover.policies.callable_identity import callable_hash

    return callable_hash(policy)


def linear(weight: float):
    import torch

    module = torch.nn.Linear(2, 2)
    with torch.no_grad():
        module.weight.fill_(weight), module.bias.zero_()
    return module


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (lambda: with_closure(1.0), lambda: with_closure(2.0)),
        (lambda: with_closure(np.array([1.0, 2.0])), lambda: with_closure(np.array([1.0, 2.5]))),
        (lambda: functools.partial(uses_a_helper, gain=1), lambda: functools.partial(uses_a_helper, gain=2)),
        (lambda: Counter, lambda: Slotted),
        (lambda: Counter(1.0), lambda: Counter(2.0)),
        (lambda: Counter(1.0).__call__, lambda: Counter(2.0).__call__),
        (lambda: Slotted(1.0), lambda: Slotted(2.0)),
        (lambda: with_closure(linear(1.0)), lambda: with_closure(linear(2.0))),
        (lambda: with_closure(np.random.default_rng(1)), lambda: with_closure(np.random.default_rng(2))),
    ],
)
def test_whatever_can_change_an_action_changes_the_hash(one, other):
    assert hashed(one()) == hashed(one())
    assert hashed(one()) != hashed(other())


def test_globals_and_helpers_count(monkeypatch):
    before = hashed(uses_a_helper), hashed(Counter)
    monkeypatch.setitem(globals(), "GAIN", 3.0)
    assert hashed(uses_a_helper) != before[0]
    assert hashed(Counter) != before[1]
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    assert (hashed(uses_a_helper), hashed(Counter)) == before
    monkeypatch.setitem(globals(), "helper", with_default)
    assert hashed(uses_a_helper) != before[0]


def test_sources_modules_and_files_count(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    weights = tmp_path / "weights.npy"
    weights.write_bytes(b"1")
    (tmp_path / "my_helpers.py").write_text("SCALE = 1.0\ndef f(x): return SCALE * x\n")
    source = f"import my_helpers\ndef act(o, i): return my_helpers.f(open('{weights}').read())\n"
    (tmp_path / "my_policy.py").write_text(source)
    mine = importlib.import_module("my_policy")
    before = hashed(mine.act)
    assert hashed(mine.act) == before
    weights.write_bytes(b"2")
    assert hashed(mine.act) != before
    weights.write_bytes(b"1")
    assert hashed(mine.act) == before
    monkeypatch.setattr(mine.my_helpers, "SCALE", 2.0)
    assert hashed(mine.act) != before


@pytest.mark.parametrize(
    "held", [threading.Lock(), random.Random(0), open], ids=["lock", "generator", "builtin"]
)
def test_a_compiled_object_has_no_hash_and_a_builtin_its_name(held):
    from lerobot_roborecover.policies.callable_identity import UnhashableError

    if held is open:
        assert hashed(with_closure(held)) == hashed(with_closure(open))
        return
    with pytest.raises(UnhashableError, match=r"lock|Random"):
        hashed(with_closure(held))


def test_a_function_without_a_source_has_no_hash():
    from lerobot_roborecover.policies.callable_identity import UnhashableError

    names: dict = {"__name__": "typed_in"}
    exec("def act(o, i): return [0.0, 0.0]", names)
    with pytest.raises(UnhashableError, match="no source"):
        hashed(names["act"])
