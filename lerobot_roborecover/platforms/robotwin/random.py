"""Random streams of RoboTwin's own, kept apart from those of the process it runs in.

`setup_demo` seeds numpy's and torch's global generators. A stochastic policy in the same process would repeat
its noise in every episode, and would move the task's draws on.
"""

from __future__ import annotations

import contextlib
import random
import sys
from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np


class _States(NamedTuple):
    """Of the global generators; torch's where it is imported, CUDA's where it is in use."""

    python: tuple[Any, ...]
    numpy: Any
    torch: Any
    cuda: Any


class RandomStreams:
    """The task's own states of the global generators, swapped in while its code runs."""

    def __init__(self):
        self._state: _States | None = None

    @contextlib.contextmanager
    def fresh(self, seed: int) -> Generator[None]:
        """A stream that starts from a seed (RoboTwin leaves Python's `random` unseeded)."""
        self._state = None
        with self.own():
            random.seed(seed)
            yield

    @contextlib.contextmanager
    def own(self) -> Generator[None]:
        """The task's stream within, the caller's again after."""
        callers = self._get()
        if self._state is not None:
            self._set(self._state)
        try:
            yield
        finally:
            self._state = self._get()
            self._set(callers)

    def numpy_state(self) -> list:
        """numpy's state of the task's stream as plain values."""
        name, keys, position, has_gauss, gauss = self._begun().numpy
        return [name, keys.tolist(), position, has_gauss, gauss]

    def set_numpy_state(self, state: list) -> None:
        """Puts `numpy_state` back."""
        restored = (state[0], np.array(state[1], dtype=np.uint32), *state[2:])
        self._state = self._begun()._replace(numpy=restored)

    def _begun(self) -> _States:
        if self._state is None:
            raise RuntimeError("the task's stream has not begun: `fresh` begins it")
        return self._state

    @staticmethod
    def _get() -> _States:
        torch = sys.modules.get("torch")
        cuda = None
        if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
            cuda = torch.cuda.get_rng_state_all()
        state = torch and torch.get_rng_state()
        return _States(random.getstate(), np.random.get_state(), state, cuda)

    @staticmethod
    def _set(state: _States) -> None:
        random.setstate(state.python)
        np.random.set_state(state.numpy)
        if state.torch is not None:
            sys.modules["torch"].set_rng_state(state.torch)
        if state.cuda is not None:
            sys.modules["torch"].cuda.set_rng_state_all(state.cuda)
