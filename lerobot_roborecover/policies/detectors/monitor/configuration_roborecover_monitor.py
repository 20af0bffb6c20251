"""Configuration of the Qwen3-VL monitor (paper, "LIBERO Monitor and Human Intervention")."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from lerobot.optim.schedulers import ConstantWithWarmupSchedulerConfig

from lerobot_roborecover.policies.detectors.interface import DetectorError

PROMPT = (
    "The robot is carrying out this task: {instruction}\n"
    "Look at the current view. Has the execution gone wrong, so that the robot needs help to complete the "
    "task?\nAnswer with exactly one character: 0 if the execution is on track, 1 if it has gone wrong."
)
"""The paper prints no prompt; this one is ours."""


@RewardModelConfig.register_subclass("roborecover_monitor")
@dataclass
class RoboRecoverMonitorConfig(RewardModelConfig):
    """Qwen3-VL with LoRA adapters that answers "0" or "1" to a frame."""

    base_model: str = "Qwen/Qwen3-VL-4B-Instruct"
    """Hub id or folder of a Qwen3-VL model with its processor, of any size."""
    base_revision: str | None = None
    """Commit, tag or branch of the base on the Hub; pin one."""
    base_fingerprint: str = ""
    """Hash of some of the base's weights, written with the adapters: they fit no other base."""
    inputs: str = ""
    """Camera keys to show, in this order, with commas between; empty takes all that the dataset has."""
    prompt: str = PROMPT
    """What is asked of each frame; `{instruction}` stands for the task's instruction."""
    image_size: int | None = None
    """Longest side that pictures are brought down to, pixels; None leaves them as they are."""
    lora_rank: int = 16
    """Paper: 16."""
    lora_alpha: int = 32
    lora_dropout: float = 0.05
    lora_targets: list[str] = field(
        default_factory=lambda: ["q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"]
    )
    """Linear layers of the language model that get adapters; the vision encoder stays as it is."""
    micro_batch_size: int = 4
    """Frames in memory at once during training. A batch is worked off in pieces of this size, so that
    `--batch_size=32` is the paper's 4 frames with gradients accumulated over 8 pieces. It goes with
    the oldest LeRobot, which does not accumulate (`utils/lerobot_versions.py`, `REPLACED`)."""
    gradient_checkpointing: bool = True
    """Keep only each layer's input and compute the rest again: less memory for a piece, and another forward
    pass of the language model."""
    dtype: str = "bfloat16"
    """Dtype of the base's weights and the arithmetic; adapters are float32."""
    attention: str = "sdpa"
    """Attention implementation of transformers: `sdpa`, `eager` or `flash_attention_2`."""
    max_batch: int = 16
    """Frames judged at once."""
    threshold: float | None = None
    """None: the answer decides (paper). A number: the score p("1") / (p("0") + p("1")) above it decides, for
    answers that can be read."""
    learning_rate: float = 5e-5
    """Paper: 5e-5."""
    weight_decay: float = 0.0
    grad_clip_norm: float = 1.0
    warmup_steps: int = 100
    device: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if "{instruction}" not in self.prompt:
            raise DetectorError(f"prompt={self.prompt!r:.80}: it must hold {{instruction}}")
        if self.dtype not in ("bfloat16", "float32"):
            raise DetectorError(f"dtype={self.dtype}: must be bfloat16 or float32")
        for name in ("lora_rank", "micro_batch_size", "max_batch"):
            if getattr(self, name) < 1:
                raise DetectorError(f"{name}={getattr(self, name)}: must be at least 1")
        if self.threshold is not None and not 0.0 < self.threshold < 1.0:
            raise DetectorError(f"threshold={self.threshold}: must be above 0 and below 1, or null")

    def can_read(self, key: str, feature: PolicyFeature) -> bool:
        """Whether a dataset's feature can be an input: cameras only."""
        return key.startswith("observation.") and feature.type is FeatureType.VISUAL

    def get_optimizer_preset(self) -> OptimizerConfig:
        return AdamWConfig(
            lr=self.learning_rate, weight_decay=self.weight_decay, grad_clip_norm=self.grad_clip_norm
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig:
        """A constant rate after a short warm-up; the paper names the rate alone."""
        return ConstantWithWarmupSchedulerConfig(num_warmup_steps=self.warmup_steps)
