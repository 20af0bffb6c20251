"""A policy's config where there is nothing to train."""

from __future__ import annotations


class NotTrained:
    """What LeRobot's training asks of a `PreTrainedConfig`: frames around a step to learn from, and how
    the learning rate goes. Stands before `PreTrainedConfig` among the bases."""

    @property
    def observation_delta_indices(self) -> None:
        """None: nothing is trained."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """None: nothing is trained."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """None: nothing is trained."""
        return None

    def get_scheduler_preset(self) -> None:
        """None: nothing is trained."""
