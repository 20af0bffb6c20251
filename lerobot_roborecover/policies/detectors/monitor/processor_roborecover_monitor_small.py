"""Processors of the small monitor: they move to the device; the model normalises by itself."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from lerobot_roborecover.policies.detectors.monitor.configuration_roborecover_monitor_small import (
    RoboRecoverMonitorSmallConfig,
)
from lerobot_roborecover.policies.detectors.monitor.processors import plain_processors


def make_roborecover_monitor_small_pre_post_processors(
    config: RoboRecoverMonitorSmallConfig, dataset_stats: Any = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Processors for `lerobot-train`; `dataset_stats` are the model's business."""
    return plain_processors(str(config.device))
