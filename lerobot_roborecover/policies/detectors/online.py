"""A detector beside trials that are under way, whatever it needs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from lerobot_roborecover.policies.detectors.interface import (
    Detector,
    DetectorHistory,
    DetectorWindow,
    StepObservation,
    Verdicts,
)
from lerobot_roborecover.policies.detectors.probe import PolicyProbe

if TYPE_CHECKING:
    import torch


class OnlineDetector:
    """Shows trials to a detector, step by step.

    Args:
        detector: scores the trials.
        probe: into the policy that acts; None where the detector asks nothing of it.
    """

    def __init__(self, detector: Detector, probe: PolicyProbe | None = None):
        self.detector = detector
        self._needs = detector.needs
        self._probe = probe if self._needs.of_policy else None
        if self._needs.of_policy and probe is None:
            raise ValueError("the detector looks into the policy that acts, and there is no way into it")
        self._past = max(self._needs.past, self._probe.past if self._probe else 0)

    @property
    def max_batch(self) -> int:
        """Trials judged at once."""
        return max(self.detector.max_batch, 1)

    def start(self, seed: int | None) -> DetectorHistory:
        """A trial of that seed, of which nothing has been seen."""
        return DetectorHistory(self._past, seed)

    def judge(
        self,
        watches: Sequence[DetectorHistory],
        observations: Sequence[Mapping[str, torch.Tensor]],
        instructions: Sequence[str],
    ) -> Verdicts:
        """Shows one more step of each trial, and asks.

        Args:
            watches: of the trials, updated here.
            observations: of this step, LeRobot keys without a batch axis.
            instructions: of their tasks.
        """
        windows: list[DetectorWindow] = []
        for watch, observation, text in zip(watches, observations, instructions, strict=True):
            windows.append(watch.show(StepObservation(observation), text))
        if self._probe is not None:
            looks = self._probe.look(
                [[g.observation for g in w.observations] for w in windows],
                instructions,
                [noise_seed(w.seed, w.step) for w in windows],
                self._needs,
            )
            windows = [watch.amend(*look) for watch, look in zip(watches, looks, strict=True)]
        return self.detector.judge_windows(windows)


def noise_seed(seed: int, step: int) -> int:
    """Seed of what a policy is asked for beside the trial, at a step of it."""
    return (seed * 1_000_003 + step) % 2**62
