"""Stand-ins for a monitor, a person and policies, all deterministic."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_roborecover.policies.detectors.interface import DetectorNeeds, Verdicts
from lerobot_roborecover.policies.runner import PolicyError

if TYPE_CHECKING:
    import torch


class FrameDetector:
    """A detector that looks at the last observation alone, as monitors do; subclasses have `judge`."""

    fitted = decides = probabilities = True
    trained_on: dict = {}  # noqa: RUF012 - never written

    def __init__(self, keys=()):
        self.input_features = dict.fromkeys(keys)

    @property
    def needs(self):
        return DetectorNeeds(features=self.input_features)

    def judge_windows(self, windows):
        import torch

        keys = windows[0].observations[-1].observation
        seen = {k: torch.stack([w.observations[-1].observation[k] for w in windows]) for k in keys}
        return self.judge(seen, [w.instruction for w in windows])


class HashMonitor(FrameDetector):
    """Judges the fake simulator's state by its digits: as good as random, the same wherever it is asked."""

    max_batch = 3

    def __init__(self, keys=("observation.state",), threshold: float = 0.9):
        super().__init__(keys)
        self.threshold = threshold
        self.asked = 0

    def judge(self, observations, instructions):
        state = observations["observation.state"].cpu().numpy().astype(np.float64)
        assert len(state) == len(instructions) <= self.max_batch
        self.asked += len(state)
        scores = (np.abs(state[:, 0]) * 1000.0 % 1.0).astype(np.float32)
        scores[(scores > 0.3) & (scores < 0.45)] = np.nan
        # What is unparsable must not trigger, whatever the monitor says.
        return Verdicts(scores, (scores > self.threshold) | np.isnan(scores))


class ScriptedController:
    """A person who drives `steps` steps to the left and is done."""

    def __init__(self, steps: int = 4):
        self.steps = steps
        self.taken: list[dict] = []

    def take(self, instruction):
        self.taken.append({"instruction": instruction, "left": self.steps, "over": False})
        return self.taken[-1]

    def act(self, slot, observation):
        assert observation["observation.state"].shape == (4,)
        if not slot["left"]:
            return None
        slot["left"] -= 1
        return np.array([-1.0, 0.25], np.float32)

    def leave(self, slot):
        assert not slot["over"]
        slot["over"] = True


def scripted_controller():
    """What `--policy.controller=tests.support.small_interventions:scripted_controller` calls."""
    return ScriptedController()


class CountingMember:
    """A policy whose actions say who chose them, in which of its histories, and at which step of that."""

    action_width = 3
    batched = True
    max_batch = 64

    def __init__(self, name: float, chunk: int):
        self._name, self._chunk = name, chunk
        self.begun = self.finished = 0

    def start(self, seed):
        self.begun += 1
        return SimpleNamespace(stream=seed, step=0)

    def finish(self, history):
        self.finished += 1

    def act(self, observations, instructions, histories):
        chunks = []
        for observation, history in zip(observations, histories, strict=True):
            if observation["observation.state"][0, 1] > 0.5:
                chunks.append(PolicyError("broke on purpose"))
                continue
            steps = history.step + np.arange(self._chunk, dtype=np.float32)
            history.step += self._chunk
            rows = [[self._name, step, float(observation["observation.state"][0, 0])] for step in steps]
            chunks.append(np.array(rows, np.float32))
        return chunks


def observation(value: float, bad: bool = False) -> dict[str, torch.Tensor]:
    """One slot's, with a batch axis of 1."""
    import torch

    return {"observation.state": torch.tensor([[value, float(bad)]])}
