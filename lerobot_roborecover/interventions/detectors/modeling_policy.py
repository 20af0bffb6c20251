"""Detectors that look at the policy that acts: its action chunks, and its features."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_roborecover.interventions.detectors.base import DetectorRewardModel
from lerobot_roborecover.interventions.detectors.configuration_policy import (
    RoboRecoverChunkDisagreementConfig,
    RoboRecoverPolicyFeaturesConfig,
)
from lerobot_roborecover.interventions.detectors.interface import CHUNKS, FEATURES, SEEN, DetectorNeeds
from lerobot_roborecover.interventions.monitor.errors import MonitorError


class RoboRecoverChunkDisagreementRewardModel(DetectorRewardModel):
    """Energy distance between the chunks of `lag` steps ago and those of now, over the steps that both plan.

    With one chunk each (a policy without noise) it is twice their distance. The paper's maximum mean
    discrepancy needs a kernel width; the energy distance has none.
    """

    config_class = RoboRecoverChunkDisagreementConfig
    name = "roborecover_chunk_disagreement"
    config: RoboRecoverChunkDisagreementConfig

    @property
    def needs(self) -> DetectorNeeds:
        """Chunks of now and of `lag` steps ago."""
        return DetectorNeeds(past=self.config.lag, chunks=self.config.samples)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) distances per planned step, in the policy's normalised units; 0 until `lag` steps were seen.

        Raises:
            MonitorError: chunks are no longer than the lag.
        """
        chunks, lag = batch[CHUNKS].float(), self.config.lag
        length = chunks.shape[3]
        if length <= lag:
            raise MonitorError(
                f"chunk_disagreement, lag={lag}: the policy's chunks have {length} steps, and two that are "
                f"{lag} steps apart share none. Set lag below {length}"
            )
        before = chunks[:, 0, :, lag:].flatten(2)
        now = chunks[:, -1, :, : length - lag].flatten(2)
        between, own_before, own_now = _apart(before, now), _apart(before, before), _apart(now, now)
        distance = (2 * between - own_before - own_now) / (length - lag) ** 0.5
        return torch.where(batch[SEEN] > lag, distance, torch.zeros_like(distance))


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """(B,) mean distance of (B, K, n) from (B, L, n) points."""
    return (a[:, :, None] - b[:, None]).norm(dim=3).mean((1, 2))


class RoboRecoverPolicyFeaturesRewardModel(DetectorRewardModel):
    """Chance that the policy does not recover by itself, from its features of now."""

    config_class = RoboRecoverPolicyFeaturesConfig
    name = "roborecover_policy_features"
    config: RoboRecoverPolicyFeaturesConfig
    mean: Tensor
    """(F,) of the features that it was fitted to."""
    std: Tensor
    """(F,) of the same."""

    def __init__(self, config: RoboRecoverPolicyFeaturesConfig, **_: Any):
        super().__init__(config)
        self.fitted = False
        if config.width:
            self._build(config.width)

    @property
    def needs(self) -> DetectorNeeds:
        """The policy's features."""
        return DetectorNeeds(internals=True)

    def _build(self, width: int) -> None:
        c = self.config
        c.width = width
        self.fill("mean", torch.zeros(width))
        self.fill("std", torch.ones(width))
        self.head = nn.Sequential(
            nn.Linear(width, c.hidden_dim), nn.GELU(), nn.Dropout(c.dropout), nn.Linear(c.hidden_dim, 1)
        )

    def fit(self, features: Tensor, labels: Tensor) -> float:
        """Trains it; both labels weigh the same.

        Args:
            features: (N, F).
            labels: (N,) 0 or 1.

        Returns:
            The last hundred steps' mean loss.

        Raises:
            MonitorError: one of the labels is missing.
        """
        counts = [int((labels == v).sum()) for v in (0, 1)]
        if not all(counts):
            raise MonitorError(
                f"policy_features: {counts[0]} frames where the policy goes on by itself and {counts[1]} "
                "where it does not; both are needed to learn from. Fit on more scenarios (--fit-split)"
            )
        c = self.config
        c.labels = {"0": counts[0], "1": counts[1]}
        with torch.random.fork_rng(), torch.enable_grad():
            torch.manual_seed(c.seed)
            self._build(features.shape[1])
            self.mean.copy_(features.mean(0))
            std = features.std(0)
            self.std.copy_(torch.where(std < 1e-6, torch.ones_like(std), std))
            optimizer = torch.optim.AdamW(self.parameters(), c.learning_rate, weight_decay=c.weight_decay)
            weight = torch.tensor([len(labels) / (2 * n) for n in counts])
            losses = []
            self.train()
            for _ in range(c.steps):
                rows = torch.randint(len(labels), (c.batch_size,))
                logits = self._logits(features[rows])
                loss = nn.functional.binary_cross_entropy_with_logits(
                    logits, labels[rows].float(), weight[labels[rows].long()]
                )
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(loss.item())
            self.eval()
        self.fitted = True
        return sum(losses[-100:]) / len(losses[-100:])

    def restore(self, weights: Any) -> None:
        """Takes saved weights."""
        try:
            self.load_state_dict(weights())
        except RuntimeError as err:
            raise MonitorError(f"policy_features: weights do not fit config.json: {err}") from None
        self.fitted = True

    def _logits(self, features: Tensor) -> Tensor:
        return self.head((features - self.mean) / self.std).squeeze(1)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) probabilities.

        Raises:
            MonitorError: it has not been fitted, or to another policy's features.
        """
        features = batch[FEATURES].float()
        if not self.fitted or features.shape[1] != self.config.width:
            raise MonitorError(
                f"policy_features was fitted to {self.config.width} features; the policy has "
                f"{features.shape[1]}. Fit it to this policy"
            )
        return torch.sigmoid(self._logits(features))
