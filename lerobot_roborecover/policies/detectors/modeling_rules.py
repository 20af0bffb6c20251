"""Detectors that follow a rule."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lerobot_roborecover.policies.detectors.base import DetectorRewardModel
from lerobot_roborecover.policies.detectors.configuration_rules import (
    RoboRecoverConstantConfig,
    RoboRecoverElapsedConfig,
    RoboRecoverNoProgressConfig,
    RoboRecoverOracleConfig,
)
from lerobot_roborecover.policies.detectors.interface import (
    DEVIATED,
    SEED,
    SEEN,
    STEP,
    WILL_FAIL,
    DetectorNeeds,
)

_MIX = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
"""Odd 32-bit constants of xxHash."""


class RoboRecoverConstantRewardModel(DetectorRewardModel):
    """A number drawn evenly from [0, 1), the same for the same trial and step."""

    config_class = RoboRecoverConstantConfig
    name = "roborecover_constant"
    config: RoboRecoverConstantConfig

    @property
    def needs(self) -> DetectorNeeds:
        return DetectorNeeds()

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) draws: a hash of seed and step, so that neither batch nor order decides."""
        value = (batch[SEED] * _MIX[0] + batch[STEP] * _MIX[1]) % 2**32
        for factor in _MIX[1:]:
            value = ((value ^ (value >> 15)) * factor) % 2**32
        return ((value ^ (value >> 13)) % 2**24).float() / 2**24


class RoboRecoverElapsedRewardModel(DetectorRewardModel):
    """Scores by the steps since the watch began."""

    config_class = RoboRecoverElapsedConfig
    name = "roborecover_elapsed"
    config: RoboRecoverElapsedConfig

    @property
    def needs(self) -> DetectorNeeds:
        return DetectorNeeds()

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) steps over `steps`."""
        return batch[STEP].float() / self.config.steps


class RoboRecoverNoProgressRewardModel(DetectorRewardModel):
    """Scores by how little the state has moved."""

    config_class = RoboRecoverNoProgressConfig
    name = "roborecover_no_progress"
    config: RoboRecoverNoProgressConfig

    @property
    def needs(self) -> DetectorNeeds:
        """The vectors that are to move."""
        keys = [k.strip() for k in self.config.keys.split(",") if k.strip()]
        return DetectorNeeds(features=dict.fromkeys(keys), past=self.config.steps)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) from 0 to 1: scale / (scale + furthest way from where it was `steps` ago)."""
        states = torch.cat([batch[k].flatten(2).float() for k in self.needs.features], dim=2)
        furthest = (states - states[:, :1]).norm(dim=2).amax(1)
        score = self.config.scale / (self.config.scale + furthest)
        return torch.where(batch[SEEN] > self.config.steps, score, torch.zeros_like(score))


class RoboRecoverOracleRewardModel(DetectorRewardModel):
    """The truth itself."""

    config_class = RoboRecoverOracleConfig
    name = "roborecover_oracle"
    config: RoboRecoverOracleConfig

    @property
    def needs(self) -> DetectorNeeds:
        """A ground truth that is known to an evaluation alone."""
        return DetectorNeeds(truth=self.config.truth)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """(B,) 0 or 1; NaN where unknown."""
        return batch[DEVIATED if self.config.truth == "recovery_point" else WILL_FAIL]
