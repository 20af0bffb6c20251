"""Detectors that look at the policy that acts: its action chunks, and its features."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lerobot_roborecover.policies.detectors.base import PREFIX, DetectorRewardModel
from lerobot_roborecover.policies.detectors.configuration_policy import (
    FeatureNetworkConfig,
    RoboRecoverChunkDisagreementConfig,
    RoboRecoverPolicyFeaturesConfig,
    RoboRecoverRecoveryGainConfig,
)
from lerobot_roborecover.policies.detectors.interface import (
    CHUNKS,
    FEATURES,
    SEEN,
    DetectorError,
    DetectorNeeds,
)


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
            DetectorError: chunks are no longer than the lag.
        """
        chunks, lag = batch[CHUNKS].float(), self.config.lag
        length = chunks.shape[3]
        if length <= lag:
            raise DetectorError(
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


class FeatureNetwork(DetectorRewardModel):
    """A small network on the policy's features of now."""

    mean: Tensor
    """(F,) of the features that it was fitted to."""
    std: Tensor
    """(F,) of the same."""

    def __init__(self, config: FeatureNetworkConfig, **_: Any):
        super().__init__(config)
        self.fitted = False
        if config.width:
            self._build(config.width)

    @property
    def needs(self) -> DetectorNeeds:
        return DetectorNeeds(internals=True)

    def restore(self, weights: Any) -> None:
        try:
            self.load_state_dict(weights())
        except RuntimeError as err:
            raise DetectorError(f"{self._kind}: weights do not fit config.json: {err}") from None
        self.fitted = True

    @property
    def _kind(self) -> str:
        return self.config.type.removeprefix(PREFIX)

    def _build(self, width: int) -> None:
        c: FeatureNetworkConfig = self.config
        c.width = width
        self.fill("mean", torch.zeros(width))
        self.fill("std", torch.ones(width))
        self.head = nn.Sequential(
            nn.Linear(width, c.hidden_dim), nn.GELU(), nn.Dropout(c.dropout), nn.Linear(c.hidden_dim, 1)
        )

    def _train(self, features: Tensor, targets: Tensor, weights: Tensor) -> float:
        """Towards the mean of what is seen where features are alike.

        Args:
            features: (N, F).
            targets: (N,) from 0 to 1.
            weights: (N,) of the losses.

        Returns:
            The last hundred steps' mean loss.
        """
        c = self.config
        with torch.random.fork_rng(), torch.enable_grad():
            torch.manual_seed(c.seed)
            self._build(features.shape[1])
            self.mean.copy_(features.mean(0))
            std = features.std(0)
            self.std.copy_(torch.where(std < 1e-6, torch.ones_like(std), std))
            optimizer = torch.optim.AdamW(self.parameters(), c.learning_rate, weight_decay=c.weight_decay)
            losses = []
            self.train()
            for _ in range(c.steps):
                rows = torch.randint(len(targets), (c.batch_size,))
                loss = nn.functional.binary_cross_entropy_with_logits(
                    self._logits(features[rows]), targets[rows], weights[rows]
                )
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(loss.item())
            self.eval()
        self.fitted = True
        return sum(losses[-100:]) / len(losses[-100:])

    def _logits(self, features: Tensor) -> Tensor:
        return self.head((features - self.mean) / self.std).squeeze(1)

    def _means(self, batch: dict[str, Any]) -> Tensor:
        """(B,) expected targets.

        Raises:
            DetectorError: it has not been fitted, or to another policy's features.
        """
        features = batch[FEATURES].float()
        if not self.fitted or features.shape[1] != self.config.width:
            raise DetectorError(
                f"{self._kind} was fitted to {self.config.width} features; the policy has "
                f"{features.shape[1]}. Fit it to this policy"
            )
        return torch.sigmoid(self._logits(features))


class RoboRecoverPolicyFeaturesRewardModel(FeatureNetwork):
    """Chance that the policy does not recover by itself."""

    config_class = RoboRecoverPolicyFeaturesConfig
    name = "roborecover_policy_features"
    probabilities = True

    def fit(self, features: Tensor, labels: Tensor) -> float:
        """Trains it; both labels weigh the same.

        Args:
            features: (N, F).
            labels: (N,) 0 or 1.

        Returns:
            The last hundred steps' mean loss.

        Raises:
            DetectorError: one of the labels is missing.
        """
        counts = [int((labels == v).sum()) for v in (0, 1)]
        if not all(counts):
            raise DetectorError(
                f"policy_features: {counts[0]} frames where the policy goes on by itself and {counts[1]} "
                "where it does not; both are needed to learn from. Fit on more scenarios (--fit-split)"
            )
        self.config.labels = {"0": counts[0], "1": counts[1]}
        weights = torch.tensor([len(labels) / (2 * n) for n in counts])
        return self._train(features, labels.float(), weights[labels.long()])

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) probabilities.

        Raises:
            DetectorError: it has not been fitted, or to another policy's features.
        """
        return self._means(batch)


class RoboRecoverRecoveryGainRewardModel(FeatureNetwork):
    """Predicts the expected gain of an intervention now: from -1 (harms) to 1 (rescues)."""

    config_class = RoboRecoverRecoveryGainConfig
    name = "roborecover_recovery_gain"
    least_threshold = 0.0

    def fit(self, features: Tensor, gains: Tensor) -> float:
        """Trains the model to predict the expected gain: a state with gain and harm has their mean as target.

        Args:
            features: (N, F) where trials were forked.
            gains: (N,) success with an intervention, less success when the policy goes on.

        Returns:
            The last hundred steps' mean loss.

        Raises:
            DetectorError: the intervention rescued no trial.
        """
        counts = {"rescued": gains > 0, "harmed": gains < 0, "alike": gains == 0}
        self.config.labels = {name: int(rows.sum()) for name, rows in counts.items()}
        if not self.config.labels["rescued"]:
            raise DetectorError(
                f"recovery_gain: of {len(gains)} forks the intervention rescued none "
                f"({self.config.labels['harmed']} harmed), so there is no gain to learn. Fork more trials "
                "(roborecover detect fork --stride), or with another --arm"
            )
        return self._train(features, (1 + gains.float()) / 2, torch.ones(len(gains)))

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) expected gains.

        Raises:
            DetectorError: it has not been fitted, or to another policy's features.
        """
        return 2 * self._means(batch) - 1
