"""An average of the weights over training, on a LeRobot that keeps none: AdamW with a shadow.

`--optimizer.type=roborecover_ema_adamw` trains as `adamw` does and keeps, in the optimizer's own state, an
exponential moving average of every weight: shadow = decay * shadow + (1 - decay) * weight after each step,
from the weights before the first one (paper, "Correction Data and Training": 0.999). LeRobot saves the
optimizer's state with each checkpoint and loads it on `--resume`, and the shadow with it; `roborecover
export-ema` turns it into a plain checkpoint.

LeRobot averages by itself from huggingface/lerobot#4323 on. There this optimizer is not needed any more; it
works as before, so that one training configuration does for both, and names the options to use instead. It
goes with the oldest LeRobot (`utils/lerobot_versions.py`, `REPLACED`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, overload

import torch
from lerobot.optim.optimizers import AdamWConfig, OptimizerConfig

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.lerobot_versions import averages_weights

logger = logging.getLogger(__name__)

SHADOW = "ema"
"""Key of the shadow in the optimizer's state of a parameter."""


class EmaAdamW(torch.optim.AdamW):
    """AdamW that averages the weights it updates. The shadow is float32 whatever the weights are.

    Args:
        params: as `torch.optim.AdamW` takes them.
        ema_decay: of the average, in [0, 1).
        options: of `torch.optim.AdamW`.
    """

    def __init__(self, params: Any, ema_decay: float = 0.999, **options: Any):
        super().__init__(params, **options)
        self.defaults["ema_decay"] = ema_decay
        for group in self.param_groups:
            group["ema_decay"] = ema_decay

    @overload
    def step(self, closure: None = None) -> None: ...

    @overload
    def step(self, closure: Callable[[], float]) -> float: ...

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """One step of AdamW, then of the average."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is not None and SHADOW not in self.state[weight]:
                    _start(self.state[weight], weight)
        loss = super().step(closure)
        for group in self.param_groups:
            for weight in group["params"]:
                shadow = self.state[weight].get(SHADOW) if weight in self.state else None
                if shadow is not None:
                    shadow.lerp_(weight.detach().to(shadow.dtype), 1.0 - group["ema_decay"])
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Loads a state; torch would round the shadow of a bfloat16 weight to bfloat16."""
        super().load_state_dict(state_dict)
        weights = [weight for group in self.param_groups for weight in group["params"]]
        for index, entry in state_dict["state"].items():
            if SHADOW in entry:
                weight = weights[index]
                self.state[weight][SHADOW] = entry[SHADOW].to(weight.device, torch.float32, copy=True)


def _start(state: dict[str, Any], weight: torch.Tensor) -> None:
    """Begins the average, and AdamW's own state, which torch begins only where there is none at all."""
    state["step"] = torch.tensor(0.0, dtype=torch.float32)
    state["exp_avg"] = torch.zeros_like(weight, memory_format=torch.preserve_format)
    state["exp_avg_sq"] = torch.zeros_like(weight, memory_format=torch.preserve_format)
    state[SHADOW] = weight.detach().to(torch.float32, copy=True)


@OptimizerConfig.register_subclass("roborecover_ema_adamw")
@dataclass
class EmaAdamWConfig(AdamWConfig):
    """AdamW with an average of the weights."""

    ema_decay: float = 0.999
    """Weight of the past in the average (paper: 0.999)."""

    def build(self, params: Any) -> torch.optim.Optimizer:
        """The optimizer.

        Raises:
            OptionError: the decay is none.
        """
        if not 0.0 <= self.ema_decay < 1.0:
            raise OptionError(f"--optimizer.ema_decay={self.ema_decay}: at least 0, and below 1")
        if averages_weights():
            logger.warning(
                "roborecover_ema_adamw is not needed on this LeRobot, which averages weights by itself: with "
                "'type: adamw' in place of 'type' and 'ema_decay' under 'optimizer', --ema.enable=true "
                "--ema.decay=%s writes checkpoints/<step>/pretrained_model_ema, and export-ema is not needed",
                self.ema_decay,
            )
        options = asdict(self)
        options.pop("grad_clip_norm")
        return EmaAdamW(params, **options)
