"""Reads the configuration of a running `lerobot-eval`, which LeRobot 0.6.1 does not pass to environments.

LeRobot makes an env from its `EnvConfig` and a batch size alone. But the trial log must name the evaluated
policy, and a batch size that does not divide the trials must be refused before a simulator starts. LeRobot's
script holds the parsed configuration in a local variable while it makes the env; this module reads that
variable. It parses no command line again and changes nothing in LeRobot. Other callers get the defaults.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from lerobot.configs.default import EvalConfig
from lerobot.configs.eval import EvalPipelineConfig

from lerobot_roborecover.policies.metadata import PolicyMetadata, policy_metadata


def metadata_of_caller(env: Any) -> PolicyMetadata:
    """Facts of the evaluation that is making an env; defaults where there is none.

    Args:
        env: the env's configuration.
    """
    config = _callers_config(env)
    if config is None or config.policy is None:
        return PolicyMetadata()
    return policy_metadata(
        config.policy,
        rename_map=config.rename_map,
        n_episodes=config.eval.n_episodes,
        batch_size=config.eval.batch_size,
        lerobots_batch=config.eval.batch_size == EvalConfig(n_episodes=config.eval.n_episodes).batch_size,
        output_dir=None if config.output_dir is None else Path(config.output_dir),
    )


def _callers_config(env: Any) -> EvalPipelineConfig | None:
    frame = sys._getframe(1)
    while frame is not None:
        for value in frame.f_locals.values():
            if isinstance(value, EvalPipelineConfig) and value.env is env:
                return value
        frame = frame.f_back
    return None
