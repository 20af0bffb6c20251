"""Distance from training states: k-nearest neighbours, or Mahalanobis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_roborecover.policies.detectors.base import DetectorRewardModel
from lerobot_roborecover.policies.detectors.configuration_states import RoboRecoverStateDistanceConfig
from lerobot_roborecover.policies.detectors.interface import TASK, DetectorError, DetectorNeeds

_STILL = 1e-6
"""Standard deviation below which a number never changes in training; it is compared as it is."""
_RIDGE = 1e-3
"""Added to the variances of a covariance of standardised numbers, so that it can be inverted."""


class RoboRecoverStateDistanceRewardModel(DetectorRewardModel):
    """The further from what the policy was trained on, the higher; in standard deviations of the training
    states."""

    config_class = RoboRecoverStateDistanceConfig
    name = "roborecover_state_distance"
    config: RoboRecoverStateDistanceConfig
    states: Tensor
    """(N, W) standardised training states."""
    task: Tensor
    """(N,) index of each one's instruction."""
    mean: Tensor
    """(W,) of the training states."""
    std: Tensor
    """(W,) of the same; 1 where they never change."""

    def __init__(self, config: RoboRecoverStateDistanceConfig, **_: Any):
        super().__init__(config)
        self.fitted = False
        self._whitened: dict[int, tuple[Tensor, Tensor]] = {}

    @property
    def needs(self) -> DetectorNeeds:
        """The vectors that are compared."""
        return DetectorNeeds(features=dict.fromkeys(self.config.key_list))

    def fit(self, observations: Mapping[str, Tensor], instructions: Sequence[str]) -> None:
        """Takes training states.

        Args:
            observations: (N, n) by key; others are ignored.
            instructions: N.

        Raises:
            DetectorError: too few of them, or one is not finite.
        """
        states = torch.cat([observations[k].flatten(1).float() for k in self.config.key_list], dim=1)
        if len(states) <= self.config.k or not torch.isfinite(states).all():
            raise DetectorError(
                f"state_distance: {len(states)} training states, {int((~torch.isfinite(states)).sum())} "
                f"numbers in them not finite; it takes more than k={self.config.k}, all finite"
            )
        generator = torch.Generator().manual_seed(self.config.seed)
        keep = torch.randperm(len(states), generator=generator)[: self.config.max_states].sort().values
        std = states.std(0)
        std = torch.where(std < _STILL, torch.ones_like(std), std)
        names = sorted(set(instructions))
        self.config.instructions = names
        task = torch.tensor([names.index(i) for i in instructions])
        self._take(((states - states.mean(0)) / std)[keep], task[keep], states.mean(0), std)

    def _take(self, states: Tensor, task: Tensor, mean: Tensor, std: Tensor) -> None:
        for name, value in (("states", states), ("task", task), ("mean", mean), ("std", std)):
            self.fill(name, value)
        self._whitened = {}
        self.fitted = True

    def restore(self, weights: Any) -> None:
        """Takes saved training states."""
        found = weights()
        self._take(*(found[name] for name in ("states", "task", "mean", "std")))

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) distances, divided by the root of the width: of order 1 within the training states."""
        if not self.fitted:
            raise DetectorError("state_distance has not been fitted to training states")
        states = torch.cat([batch[k].flatten(1).float() for k in self.config.key_list], dim=1)
        if states.shape[1] != self.states.shape[1]:
            raise DetectorError(
                f"state_distance was fitted to {self.states.shape[1]} numbers; here are {states.shape[1]}. "
                "Fit it to this environment's states"
            )
        states = (states - self.mean) / self.std
        index = {text: i for i, text in enumerate(self.config.instructions)}
        groups = [index.get(text, -1) if self.config.by_task else -1 for text in batch[TASK]]
        scores = torch.empty(len(states))
        for group in sorted(set(groups)):
            mine = torch.tensor([g == group for g in groups])
            scores[mine] = self._distance(states[mine], group)
        return scores / states.shape[1] ** 0.5

    def _distance(self, states: Tensor, group: int) -> Tensor:
        of_group = self.states if group < 0 else self.states[self.task == group]
        if self.config.method == "knn":
            # In pieces of one row: torch.cdist rounds otherwise in another batch.
            k = min(self.config.k, len(of_group))
            return torch.stack([(of_group - s).norm(dim=1).kthvalue(k).values for s in states])
        if group not in self._whitened:
            mean = of_group.mean(0)
            around = (of_group - mean).double()
            covariance = around.T @ around / max(len(of_group) - 1, 1)
            covariance += _RIDGE * torch.eye(len(covariance), dtype=torch.float64)
            self._whitened[group] = (mean, torch.linalg.inv(torch.linalg.cholesky(covariance)).float())
        mean, whiten = self._whitened[group]
        return torch.stack([(whiten @ (s - mean)).norm() for s in states])
