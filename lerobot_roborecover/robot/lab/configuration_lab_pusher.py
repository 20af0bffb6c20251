"""Configuration of the lab's scripted policy."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.optim import OptimizerConfig

from lerobot_roborecover.policies.not_trained import NotTrained


@PreTrainedConfig.register_subclass("lab_pusher")
@dataclass
class LabPusherConfig(NotTrained, PreTrainedConfig):
    """Pushes the puck of the lab's table to a goal, by what the camera above shows. It has no weights."""

    goal_x_mm: float = -300.0
    """Where along the table the puck is to go."""
    bias_mm: float = 0.0
    """How far the policy believes the puck to be from where it is, across the table: a worse policy."""
    reach_mm: float = 60.0
    """How far ahead of the hand a target lies, at most."""
    n_action_steps: int = 1

    def validate_features(self) -> None:
        """Whatever the camera shows."""

    def get_optimizer_preset(self) -> OptimizerConfig:
        """Nothing to optimise.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a scripted policy is not trained")
