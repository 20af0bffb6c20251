"""Processors of the policy type `roborecover_remote`: none of its own; the server has the policy's."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import (
    DeviceProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
)
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_roborecover.policies.remote.configuration_remote import RemoteConfig


def make_roborecover_remote_pre_post_processors(
    config: RemoteConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Observations and actions as they are: in the env's keys, unnormalised, on the CPU.

    Args:
        config: of the policy.
        dataset_stats: not used.
    """
    steps = [RenameObservationsProcessorStep(rename_map={}), DeviceProcessorStep(device="cpu")]
    return (
        PolicyProcessorPipeline[dict[str, Any], dict[str, Any]](
            steps=steps, name=POLICY_PREPROCESSOR_DEFAULT_NAME
        ),
        PolicyProcessorPipeline[PolicyAction, PolicyAction](
            steps=[],
            name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )


make_remote_pre_post_processors = make_roborecover_remote_pre_post_processors
"""LeRobot looks for the function by the policy type; `remote` is the type's earlier name."""
