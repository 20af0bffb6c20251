"""The small monitor: milliseconds a frame on a CPU."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType
from safetensors.torch import save_file
from torch import Tensor, nn

from lerobot_roborecover.policies.detectors.base import Answers
from lerobot_roborecover.policies.detectors.files import WEIGHTS_FILE
from lerobot_roborecover.policies.detectors.interface import TASK, DetectorError
from lerobot_roborecover.policies.detectors.monitor.base import MonitorRewardModel
from lerobot_roborecover.policies.detectors.monitor.configuration_roborecover_monitor_small import (
    RoboRecoverMonitorSmallConfig,
)

_FURTHEST = 10.0
"""Normalised values are cut off here: a state far outside the training data should not drown the others."""


class RoboRecoverMonitorSmallRewardModel(MonitorRewardModel):
    """CNN on pictures, MLP on vectors and the instruction's index, one logit.

    Mean and standard deviation of the vectors are buffers of the model: LeRobot 0.6.1 neither reloads a
    reward model's processors nor passes statistics on resume, so a normaliser there would be lost silently.
    """

    config_class = RoboRecoverMonitorSmallConfig
    name = "roborecover_monitor_small"
    config: RoboRecoverMonitorSmallConfig
    mean: Tensor
    """(W,) of the vectors, one after another."""
    std: Tensor
    """(W,) of the same."""

    def __init__(
        self,
        config: RoboRecoverMonitorSmallConfig,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        super().__init__(config, dataset_stats, dataset_meta)
        if dataset_meta is not None and config.use_instruction and not config.instructions:
            config.instructions = sorted(str(name) for name in dataset_meta.tasks.index)
        features = config.input_features
        self._pictures = [k for k, f in features.items() if f.type is FeatureType.VISUAL]
        self._vectors = [k for k, f in features.items() if f.type is not FeatureType.VISUAL]
        width = sum(features[k].shape[0] for k in self._vectors)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))
        if dataset_stats and self._vectors:
            self._normalise_as(dataset_stats)
        self._index = {text: i for i, text in enumerate(config.instructions)}
        joined = width + len(config.instructions)
        if self._pictures:
            self.cnn = _cnn([3, *config.image_channels])
            joined += config.image_channels[-1] * 2 * len(self._pictures)
        layers: list[nn.Module] = []
        for _layer in range(config.n_layers):
            layers += [nn.Linear(joined, config.hidden_dim), nn.LayerNorm(config.hidden_dim), nn.GELU()]
            layers.append(nn.Dropout(config.dropout))
            joined = config.hidden_dim
        self.head = nn.Sequential(*layers, nn.Linear(joined, 1))

    def _normalise_as(self, stats: Mapping[str, Mapping[str, Any]]) -> None:
        def joined(name: str) -> Tensor:
            parts = [torch.as_tensor(stats[k][name], dtype=torch.float32).reshape(-1) for k in self._vectors]
            return torch.cat(parts)

        std = joined("std")
        self.mean.copy_(joined("mean"))
        self.std.copy_(torch.where(std < 1e-6, torch.ones_like(std), std))

    def logits(self, batch: Mapping[str, Any]) -> Tensor:
        """(B,) logits of label 1."""
        self.check_inputs(batch)
        device = self.mean.device
        parts = []
        if self._vectors:
            vectors = torch.cat([batch[k].to(device, torch.float32) for k in self._vectors], dim=1)
            vectors = ((vectors - self.mean) / self.std).clamp(-_FURTHEST, _FURTHEST)
            if self.training and self.config.state_noise:
                vectors = vectors + self.config.state_noise * torch.randn_like(vectors)
            parts.append(vectors)
        size = self.config.image_size
        for key in self._pictures:
            pictures = batch[key].to(device, torch.float32)
            if pictures.shape[-2:] != (size, size):
                pictures = nn.functional.interpolate(
                    pictures, (size, size), mode="bilinear", antialias=True, align_corners=False
                )
            seen = self.cnn(pictures * 2.0 - 1.0)
            parts += [seen.mean((2, 3)), seen.amax((2, 3))]
        count = next(iter(batch[k] for k in self.config.input_features)).shape[0]
        if self._index:
            told = torch.zeros(count, len(self._index), device=device)
            for row, text in enumerate(batch.get(TASK) or ()):
                if text in self._index:
                    told[row, self._index[text]] = 1.0
            parts.append(told)
        return self.head(torch.cat(parts, dim=1)).squeeze(1)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any]]:
        """Binary cross-entropy against the frame labels."""
        logits = self.logits(batch)
        labels = self.labels(batch).to(logits.device)
        loss = nn.functional.binary_cross_entropy_with_logits(logits, labels)
        right = ((logits > 0) == (labels > 0.5)).float().mean()
        return loss, {"accuracy": right.item(), "positives": labels.mean().item()}

    @torch.no_grad()
    def answer(self, batch: Mapping[str, Any]) -> Answers:
        """Scores and decisions; every answer can be read."""
        scores = torch.sigmoid(self.logits(batch).float())
        return Answers(scores, scores > self.config.threshold, torch.ones_like(scores, dtype=torch.bool))

    def save_weights(self, folder: Path) -> None:
        """Writes `model.safetensors`."""
        save_file({k: v.contiguous() for k, v in self.state_dict().items()}, folder / WEIGHTS_FILE)

    def restore(self, weights: Any) -> None:
        try:
            self.load_state_dict(weights())
        except RuntimeError as err:
            raise DetectorError(f"{WEIGHTS_FILE} does not fit its config.json: {err}") from None


def _cnn(channels: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(channels):
        layers += [
            nn.Conv2d(before, after, 3, stride=2, padding=1),
            nn.GroupNorm(min(8, after), after),
            nn.GELU(),
        ]
    return nn.Sequential(*layers)
