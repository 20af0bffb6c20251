"""Base class of our own detectors: a LeRobot reward model whose reward is the score."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_roborecover.policies.detectors.interface import DetectorNeeds, DetectorWindow, Verdicts, batch_of
from lerobot_roborecover.policies.detectors.monitor.base import TRAINED_ON_FILE
from lerobot_roborecover.policies.detectors.monitor.errors import MonitorError
from lerobot_roborecover.policies.detectors.monitor.files import WEIGHTS_FILE, find_file, read_trained_on

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
            MonitorError: naming the option, its value and its limit.
        """

    def refuse(self, name: str, limit: str) -> MonitorError:
        """The refusal of an option's value."""
        return MonitorError(
            f"{self.type.removeprefix(PREFIX)}, {name}={getattr(self, name)}: must be {limit}"
        )


class DetectorRewardModel(PreTrainedRewardModel):
    """A detector as a reward model: `compute_reward` gives the scores of a batch (`interface.batch_of`)."""

    # LeRobot declares both as None, for subclasses to replace.
    config_class: type[RewardModelConfig] = DetectorConfig  # ty: ignore[incompatible-attribute-override]
    name: str = "roborecover_detector"  # ty: ignore[incompatible-attribute-override]
    config: Any
    fitted: bool = True
    """Whether it can be asked: False for one that has to be fitted first, and has not been."""
    least_threshold: float = -math.inf
    """Below it no threshold is set, whatever the rate of false alarms that is allowed."""

    def __init__(self, config: Any, **_: Any):
        config.check()
        super().__init__(config)
        self.trained_on: dict[str, Any] = {}
        """Scenarios that it was fitted on, as monitors record them; empty where it was fitted on none."""

    @property
    def needs(self) -> DetectorNeeds:
        raise NotImplementedError

    @property
    def input_features(self) -> Mapping[str, Any]:
        """Observation keys that it reads."""
        return self.needs.features

    @property
    def max_batch(self) -> int:
        """Windows that it can judge at once."""
        return self.config.max_batch

    @torch.inference_mode()
    def judge_windows(self, windows: Sequence[DetectorWindow]) -> Verdicts:
        """Scores, and which of them are above the threshold."""
        scores = self.compute_reward(batch_of(windows, self.needs)).float().cpu().numpy()
        threshold = self.config.threshold
        with_help = scores > threshold if threshold is not None else scores != scores
        return Verdicts(scores=scores, triggers=with_help & (scores == scores))

    def _save_pretrained(self, save_directory: Path) -> None:
        self.config._save_pretrained(save_directory)
        state = {k: v.contiguous().cpu() for k, v in self.state_dict().items()}
        if state:
            save_file(state, save_directory / WEIGHTS_FILE)
        if self.trained_on:
            (save_directory / TRAINED_ON_FILE).write_text(json.dumps(self.trained_on, indent=1) + "\n")

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: RewardModelConfig | None = None,
        revision: str | None = None,
        **kwargs: Any,
    ) -> Self:
        """Loads a fitted detector from a folder or the Hub.

        Raises:
            MonitorError: its weights are missing or do not fit.
        """
        if config is None:
            config = RewardModelConfig.from_pretrained(pretrained_name_or_path, revision=revision)
        model = cls(config)
        model.restore(lambda: load_file(find_file(pretrained_name_or_path, WEIGHTS_FILE, revision)))
        model.trained_on = read_trained_on(pretrained_name_or_path, revision)
        return model.to(config.device).eval()

    def restore(self, weights: Any) -> None:
        """Takes what was fitted.

        Args:
            weights: gives tensors by name when called; not asked where there is nothing to restore.
        """

    def fill(self, name: str, value: Tensor) -> None:
        """Sets a buffer, whatever its shape was."""
        self.register_buffer(name, value.detach().clone().float())
