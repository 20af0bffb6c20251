"""Configuration of the small monitor."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig

from lerobot_roborecover.policies.detectors.interface import DetectorError


@RewardModelConfig.register_subclass("roborecover_monitor_small")
@dataclass
class RoboRecoverMonitorSmallConfig(RewardModelConfig):
    """A compact monitor: small CNN on pictures, MLP on state vectors, and the task it is told."""

    inputs: str = ""
    """Observation keys to read, pictures or vectors, with commas between; empty takes all that the dataset
    has."""
    use_instruction: bool = True
    """Tell the network which of the training instructions it is given; an unknown one reads as none."""
    instructions: list[str] = field(default_factory=list)
    """Training instructions, in the order of the network's input; filled from the dataset."""
    hidden_dim: int = 256
    """Width of the hidden layers."""
    n_layers: int = 3
    """Hidden layers after the inputs are joined."""
    dropout: float = 0.2
    image_size: int = 96
    """Pictures are brought to this many pixels a side."""
    image_channels: list[int] = field(default_factory=lambda: [16, 32, 64, 128])
    """Channels of the CNN's layers, each halving the picture."""
    state_noise: float = 0.0
    """Standard deviation of noise on normalised vectors during training."""
    threshold: float = 0.5
    """Score above which the answer is 1; `roborecover detect evaluate` can propose another."""
    max_batch: int = 1024
    """Frames judged at once."""
    learning_rate: float = 1e-3
    weight_decay: float = 1e-2
    grad_clip_norm: float = 1.0
    warmup_steps: int = 100
    decay_steps: int = 3000
    """Steps of the cosine decay; shortened in proportion where training takes fewer."""
    device: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.threshold < 1.0:
            raise DetectorError(f"threshold={self.threshold}: must be above 0 and below 1")
        for name in ("hidden_dim", "n_layers", "image_size", "max_batch"):
            if getattr(self, name) < 1:
                raise DetectorError(f"{name}={getattr(self, name)}: must be at least 1")

    def can_read(self, key: str, feature: PolicyFeature) -> bool:
        """Whether a dataset's feature can be an input."""
        return key.startswith("observation.") and feature.type in (
            FeatureType.VISUAL, FeatureType.STATE, FeatureType.ENV,
        )  # fmt: skip

    def get_optimizer_preset(self) -> OptimizerConfig:
        return AdamWConfig(
            lr=self.learning_rate, weight_decay=self.weight_decay, grad_clip_norm=self.grad_clip_norm
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig:
        """Warm-up and cosine decay."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.warmup_steps,
            num_decay_steps=self.decay_steps,
            peak_lr=self.learning_rate,
            decay_lr=self.learning_rate / 100,
        )
