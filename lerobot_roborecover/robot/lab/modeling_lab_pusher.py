"""The lab's scripted policy: finds the puck by its colour and pushes it, a target position at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from lerobot_roborecover.robot.lab.configuration_lab_pusher import LabPusherConfig

_FIELD_MM = 1000.0
"""Side of what the camera above sees."""
_AROUND_MM = 130.0


class LabPusherPolicy(PreTrainedPolicy):
    """Memoryless: what it sees decides what it does."""

    config_class = LabPusherConfig  # ty: ignore[invalid-assignment]
    name = "lab_pusher"  # ty: ignore[invalid-assignment]
    config: LabPusherConfig

    def __init__(self, config: LabPusherConfig, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        # LeRobot asks a policy for its device through its parameters.
        self.anchor = torch.nn.Parameter(torch.zeros(1), requires_grad=False)

    def get_optim_params(self) -> dict:
        return {}

    def reset(self) -> None:
        """There is no memory."""

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        """Is not trained.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a scripted policy is not trained")

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, 1, 2) position targets in millimetres."""
        return self.select_action(batch)[:, None]

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, 2) position targets in millimetres."""
        state = batch["observation.state"].cpu().numpy()
        pictures = batch["observation.images.top"].cpu().numpy()
        found = [self._target(s[:2], p) for s, p in zip(state, pictures, strict=True)]
        return torch.tensor(np.stack(found), dtype=torch.float32)

    def _target(self, hand: np.ndarray, picture: np.ndarray) -> np.ndarray:
        """Where to go from here: behind the puck, seen from the goal, and then through it."""
        puck = find_puck(picture)
        if puck is None:
            return hand
        puck = puck + np.array([0.0, self.config.bias_mm])
        goal = np.array([self.config.goal_x_mm, 0.0])
        toward = (goal - puck) / max(float(np.linalg.norm(goal - puck)), 1e-6)
        gap = hand - puck
        along, across = float(gap @ toward), np.array([-toward[1], toward[0]])
        if along < 0 and abs(float(gap @ across)) < 30.0:
            target = goal
        elif along > -40.0:
            target = puck + across * np.sign(float(gap @ across) or 1.0) * _AROUND_MM - 50.0 * toward
        else:
            target = puck - 110.0 * toward
        step = target - hand
        return hand + step * min(1.0, self.config.reach_mm / max(float(np.linalg.norm(step)), 1e-6))


def find_puck(picture: np.ndarray) -> np.ndarray | None:
    """(2,) place of the green puck in millimetres; None where it is not seen.

    Args:
        picture: (3, H, W) float in [0, 1], from above.
    """
    red, green, blue = picture
    rows, columns = np.nonzero(green - np.maximum(red, blue) > 0.15)
    if len(rows) < 3:
        return None
    size = picture.shape[-1]
    middle = np.array([columns.mean(), rows.mean()]) - (size - 1) / 2
    return middle * [1, -1] * _FIELD_MM / size
