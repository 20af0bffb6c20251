"""Processors of the lab's scripted policy: it takes observations as they are."""

from __future__ import annotations

from typing import Any

from lerobot_roborecover.policies.remote.processor_remote import make_remote_pre_post_processors
from lerobot_roborecover.robot.lab.configuration_lab_pusher import LabPusherConfig


def make_lab_pusher_pre_post_processors(
    config: LabPusherConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[Any, Any]:
    """Observations and actions in the robot's own units.

    Args:
        config: of the policy.
        dataset_stats: not used.
    """
    return make_remote_pre_post_processors(config, dataset_stats)  # ty: ignore[invalid-argument-type]
