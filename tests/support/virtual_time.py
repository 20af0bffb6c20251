"""Slots and a policy that take time on a clock of their own, whatever this machine is busy with.

Simulators share `cores`: where more of them work than there are cores, all slow down alike.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.workers.messages import ActResult, EpisodeSpec, EpisodeStart


class World:
    """The clock, and the work that goes on while it runs.

    Args:
        cores: simulators that can work at full speed at once.
        step_s: of a simulator, on a core of its own.
        jitter: standard deviation of what a command takes, as a part of it.
        look_s: of the pictures at a command's end, on the same core.
    """

    def __init__(self, cores: int, step_s: float, jitter: float = 0.0, look_s: float = 0.0):
        self.now = 0.0
        self.cores, self.step_s, self.jitter, self.look_s = cores, step_s, jitter, look_s
        self.rng = np.random.default_rng(0)
        self.working: list[VirtualSlot] = []
        self.core_s = 0.0
        """Work done by all simulators."""

    def clock(self) -> float:
        """Seconds since the beginning."""
        return self.now

    def advance(self, until: float, handles: Collection[Any] = ()) -> None:
        """Lets time pass, up to a moment or until a command of one of `handles` has ended."""
        while self.now < until and not any(h not in self.working for h in handles):
            speed = min(1.0, self.cores / max(len(self.working), 1))
            ends = {s: self.now + s.left_s / speed for s in self.working}
            moment = min([until, *ends.values()])
            self.core_s += (moment - self.now) * speed * len(self.working)
            for slot in self.working:
                slot.left_s -= (moment - self.now) * speed
                slot.taken_s += moment - self.now
            self.working = [s for s in self.working if ends[s] > moment]
            self.now = moment

    def wait(self, handles: list[Any], timeout_s: float) -> list[Any]:
        """The engine's wait function."""
        if timeout_s:
            self.advance(self.now + max(timeout_s, 1e-6), handles)
        return [h for h in handles if h not in self.working]


class VirtualSlot:
    """A slot of a world."""

    starting, deadline = False, float("inf")

    def __init__(self, world: World, handoff_steps: int = 2):
        self._world, self._handoff_steps = world, handoff_steps
        self._reply: Any = None
        self._spec: EpisodeSpec | None = None
        self._steps = 0
        self.left_s = self.taken_s = 0.0

    @property
    def ready(self) -> Any:
        """What `World.wait` waits on."""
        return self

    def send(self, command: str, argument: Any = None) -> None:
        """Begins a command."""
        if command == "reset":
            self._spec, self._steps, steps = argument, 0, self._handoff_steps
            handoff = Handoff(0, 0.0, True, "", None, None, None, None)
            self._reply = EpisodeStart({}, handoff)
        else:
            horizon = self._spec.scenario.task.horizon
            steps = min(len(argument), horizon - self._steps)
            self._steps += steps
            over = self._steps >= horizon
            self._reply = ActResult({}, steps, False, over, 0.0)
        world = self._world
        takes_s = steps * world.step_s + world.look_s
        self.taken_s = 0.0
        self.left_s = takes_s * max(1 + world.jitter * world.rng.standard_normal(), 0.1)
        world.working.append(self)

    def receive(self) -> Any:
        """The reply."""
        if isinstance(self._reply, ActResult):
            return replace(self._reply, seconds=self.taken_s)
        return self._reply


class VirtualHost:
    """A policy whose inference takes `fixed_s + each_s * batch`; the engine does nothing else meanwhile."""

    batched, max_batch = True, 64

    def __init__(
        self, world: World, fixed_s: float, each_s: float = 0.0, chunk: int = 10, max_batch: int = 64
    ):
        self.max_batch = max_batch
        self._world, self._fixed_s, self._each_s = world, fixed_s, each_s
        self._chunk = np.zeros((chunk, 2), np.float32)
        self.batches: list[int] = []
        self.busy_s = 0.0

    def noise(self, seed):
        return "per_trial"

    def start(self, seed):
        return None

    def finish(self, history):
        pass

    def act(self, observations, instructions, histories):
        self.batches.append(len(observations))
        seconds = self._fixed_s + self._each_s * len(observations)
        self.busy_s += seconds
        self._world.advance(self._world.now + seconds)
        return [self._chunk] * len(observations)
