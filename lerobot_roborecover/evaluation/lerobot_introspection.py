"""Reads the configuration of a running `lerobot-eval`, and has it use our env processors: LeRobot 0.6.1
offers environments no way to either.

`metadata_of_caller`: LeRobot makes an env from its `EnvConfig` and a batch size alone. But the trial log must
name the evaluated policy, and a batch size that does not divide the trials must be refused before a simulator
starts. LeRobot's script holds the parsed configuration in a local variable while it makes the env; this
module reads that variable. It parses no command line again and changes nothing in LeRobot. Other callers get
the defaults.

`choose_processors_in_scripts`: LeRobot asks the env type for its processors, except for X-VLA, which always
gets LIBERO's: observations rotated and read from LIBERO's `robot_state`, actions cut to LIBERO's seven
(`lerobot/envs/factory.py`, `make_env_pre_post_processors`). That is right on LIBERO and wrong anywhere else.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from lerobot.configs.default import EvalConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs import factory

from lerobot_roborecover.policies.metadata import PolicyMetadata, policy_metadata

_SCRIPTS = ("__main__", "lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train")
_NAME = "make_env_pre_post_processors"


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


def env_processors(env_cfg: Any, policy_cfg: Any) -> tuple[Any, Any]:
    """Pre- and postprocessor of the environment: LeRobot's, but for X-VLA on our env types other than LIBERO.

    Args:
        env_cfg: any env type's configuration.
        policy_cfg: any policy's.
    """
    choose = getattr(env_cfg, "processors_for", None)
    chosen = choose(policy_cfg) if choose is not None else None
    return chosen if chosen is not None else factory.make_env_pre_post_processors(env_cfg, policy_cfg)


def choose_processors_in_scripts() -> None:
    """Has LeRobot's running script ask `env_processors`: it offers no other way for an env type to be heard.

    Only the script's own name is set; for env types other than ours, nothing changes.
    """
    for name in _SCRIPTS:
        script = sys.modules.get(name)
        if getattr(script, _NAME, None) is factory.make_env_pre_post_processors:
            setattr(script, _NAME, env_processors)
