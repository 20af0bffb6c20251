"""Base class of our own detectors, monitors among them: LeRobot reward models."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_roborecover.policies.detectors.files import (
    TRAINED_ON_FILE,
    WEIGHTS_FILE,
    find_file,
    read_trained_on,
)
from lerobot_roborecover.policies.detectors.interface import (
    DetectorError,
    DetectorNeeds,
    DetectorWindow,
    Verdicts,
    batch_of,
)

PREFIX = "roborecover_"
"""Of our reward-model types; a detector's kind is what follows."""


@dataclass
class DetectorConfig(RewardModelConfig):
    """Options that every detector has."""

    device: str | None = "cpu"
    threshold: float | None = None
    """Score above which it alarms; `roborecover detect evaluate` sets it. None never alarms."""
    max_batch: int = 256
    """Windows judged at once."""
    policy: str = ""
    """Policy type whose chunks or features it was fitted to; empty where it reads none."""

    def check(self) -> None:
        """Refuses values that cannot be used.

        Raises:
            DetectorError: naming the option, its value and its limit.
        """

    def refuse(self, name: str, limit: str) -> DetectorError:
        """The refusal of an option's value."""
        return DetectorError(
            f"{self.type.removeprefix(PREFIX)}, {name}={getattr(self, name)}: must be {limit}"
        )


@dataclass(frozen=True)
class Answers:
    """What a detector answers for a batch of B."""

    scores: Tensor
    """(B,) float32; from monitors the probability of label 1, in [0, 1]."""
    decisions: Tensor
    """(B,) bool: intervene. Never True where the answer could not be read."""
    parsed: Tensor
    """(B,) bool: the answer could be read."""


class DetectorRewardModel(PreTrainedRewardModel):
    """A detector as a reward model: `compute_reward` gives the scores of a batch (`interface.batch_of`)."""

    # LeRobot declares both as None, for subclasses to replace.
    config_class: type[RewardModelConfig] = DetectorConfig  # ty: ignore[incompatible-attribute-override]
    name: str = "roborecover_detector"  # ty: ignore[incompatible-attribute-override]
    config: Any
    fitted: bool = True
    """Whether it can be asked: False for one that has to be fitted first, and has not been."""
    probabilities: bool = False
    """Whether its scores are probabilities."""
    least_threshold: float = -math.inf
    """Below it no threshold is set, whatever the rate of false alarms that is allowed."""
    weights_file: str = WEIGHTS_FILE

    def __init__(self, config: Any, **_: Any):
        if isinstance(config, DetectorConfig):
            config.check()
        super().__init__(config)
        self.trained_on: dict[str, Any] = {}
        """What `TRAINED_ON_FILE` holds; empty where it was fitted on none, or it is not known."""

    @property
    def needs(self) -> DetectorNeeds:
        raise NotImplementedError

    @property
    def max_batch(self) -> int:
        """Windows that it can judge at once."""
        return self.config.max_batch

    @property
    def decides(self) -> bool:
        """Whether it triggers by itself."""
        return self.config.threshold is not None

    def answer(self, batch: dict[str, Any]) -> Answers:
        """Scores and decisions of a batch, without gradients kept."""
        scores = self.compute_reward(batch).float()
        parsed = ~scores.isnan()
        threshold = self.config.threshold
        above = torch.zeros_like(parsed) if threshold is None else scores > threshold
        return Answers(scores, above & parsed, parsed)

    @torch.inference_mode()
    def judge_windows(self, windows: Sequence[DetectorWindow]) -> Verdicts:
        """Scores, and which of them trigger."""
        return self.judge_batch(batch_of(windows, self.needs))

    @torch.inference_mode()
    def judge_batch(self, batch: dict[str, Any]) -> Verdicts:
        """Scores, and which of them trigger.

        Args:
            batch: as of `interface.batch_of`, or a batch of a LeRobot dataset for a monitor.
        """
        answers = self.answer(batch)
        scores = answers.scores.float().cpu().numpy().copy()
        scores[~answers.parsed.cpu().numpy()] = np.nan
        return Verdicts(scores=scores, triggers=answers.decisions.cpu().numpy())

    def _save_pretrained(self, save_directory: Path) -> None:
        self.config._save_pretrained(save_directory)
        self.save_weights(save_directory)
        if self.trained_on:
            (save_directory / TRAINED_ON_FILE).write_text(json.dumps(self.trained_on, indent=1) + "\n")

    def save_weights(self, folder: Path) -> None:
        """Writes `model.safetensors`, if there is anything in it."""
        state = {k: v.contiguous().cpu() for k, v in self.state_dict().items()}
        if state:
            save_file(state, folder / WEIGHTS_FILE)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: RewardModelConfig | None = None,
        revision: str | None = None,
        **kwargs: Any,
    ) -> Self:
        """Loads a fitted detector from a folder or the Hub, in evaluation mode.

        Raises:
            DetectorError: its weights are missing or do not fit, or it is of another kind.
        """
        if config is None:
            config = RewardModelConfig.from_pretrained(pretrained_name_or_path, revision=revision)
        if not isinstance(config, cls.config_class):
            raise DetectorError(f"{pretrained_name_or_path}: a {config.type} is no {cls.name}")
        model = cls(config, **{k: kwargs.get(k) for k in ("dataset_stats", "dataset_meta")})
        model.restore(lambda: load_file(find_file(pretrained_name_or_path, cls.weights_file, revision)))
        model.add_trained_on(read_trained_on(pretrained_name_or_path, revision))
        return model.to(config.device).eval()

    def add_trained_on(self, earlier: dict[str, Any]) -> None:
        """Takes what the weights that were loaded had been trained on."""
        self.trained_on = earlier

    def restore(self, weights: Any) -> None:
        """Takes what was fitted.

        Args:
            weights: gives tensors by name when called; not asked where there is nothing to restore.
        """

    def fill(self, name: str, value: Tensor) -> None:
        """Sets a buffer, whatever its shape was."""
        self.register_buffer(name, value.detach().clone().float())
