"""Which env processors a policy gets.

LeRobot 0.6.1 asks the env type, except for X-VLA, which always gets LIBERO's: observations rotated and read
from LIBERO's `robot_state`, actions cut to LIBERO's seven
(`lerobot/envs/factory.py`, `make_env_pre_post_processors`). That is right on LIBERO and wrong anywhere else.
"""

from __future__ import annotations

import sys
from typing import Any

from lerobot.envs import factory

_SCRIPTS = ("__main__", "lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train")
_NAME = "make_env_pre_post_processors"


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
