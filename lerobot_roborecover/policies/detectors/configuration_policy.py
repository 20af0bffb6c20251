"""Configurations of detectors that look at the policy that acts."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs.rewards import RewardModelConfig

from lerobot_roborecover.policies.detectors.base import DetectorConfig


@RewardModelConfig.register_subclass("roborecover_chunk_disagreement")
@dataclass
class RoboRecoverChunkDisagreementConfig(DetectorConfig):
    """How much the action chunks of now contradict those of a moment ago, where both speak of the same steps
    (STAC; Agia et al. 2024, "Unpacking Failure Modes of Generative Policies"). Needs no training."""

    samples: int = 8
    """Chunks drawn at each step; a policy that draws no noise gives one."""
    lag: int = 2
    """Steps between the two; fewer than a chunk is long."""

    def check(self) -> None:
        """Sizes of at least one."""
        for name in ("samples", "lag"):
            if getattr(self, name) < 1:
                raise self.refuse(name, "at least 1")


@dataclass
class FeatureNetworkConfig(DetectorConfig):
    """A small network on what the policy itself computes before its actions."""

    hidden_dim: int = 64
    """Width of its hidden layer."""
    steps: int = 600
    """Steps of training."""
    batch_size: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    dropout: float = 0.2
    seed: int = 0
    """Seed of weights and batches."""
    width: int = 0
    """Width of the features; filled when it is fitted."""
    labels: dict[str, int] = field(default_factory=dict)
    """How many of each label it was fitted to."""

    def check(self) -> None:
        """Sizes of at least one."""
        for name in ("hidden_dim", "steps", "batch_size"):
            if getattr(self, name) < 1:
                raise self.refuse(name, "at least 1")


@RewardModelConfig.register_subclass("roborecover_policy_features")
@dataclass
class RoboRecoverPolicyFeaturesConfig(FeatureNetworkConfig):
    """Whether the policy recovers by itself (SAFE; Gu et al. 2025, "Multitask Failure Detection for
    Vision-Language-Action Models")."""


@RewardModelConfig.register_subclass("roborecover_recovery_gain")
@dataclass
class RoboRecoverRecoveryGainConfig(FeatureNetworkConfig):
    """Gain of an intervention now, P(success | intervene) - P(success | continue), fitted to forks."""

    threshold: float | None = 0.0
    """Gain above which it alarms; `roborecover detect evaluate` never sets less than 0."""
    arm: str = ""
    """Arm of the forks that it is fitted to, or how that begins (`correction`); empty where they have one."""
