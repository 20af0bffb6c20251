"""What the env configs of several platforms share: refusals, render quality, and frames of observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.simulator import Observation

if TYPE_CHECKING:
    from lerobot.envs.configs import EnvConfig


SETTLED = (
    "task", "task_ids", "episode_length", "init_states", "hard_reset", "is_libero_plus", "multitask_eval",
)  # fmt: skip
"""Options of LeRobot's own envs that a scenario settles by itself."""
NOT_OPTIONS = (*SETTLED, "features", "features_map", "render_mode", "disable_env_checker")
"""Fields of env configurations that no user sets."""
LEROBOT_OPTIONS: Mapping[str, str] = {
    "fps": "Control rate, Hz; leave it as it is: recorded prefixes are of that rate.",
    "obs_type": "What the policy sees: `pixels`, `pixels_agent_pos`, or `state`, which renders nothing.",
    "camera_name": "Cameras that are rendered, separated by commas.",
    "camera_names": "Cameras that are rendered, separated by commas.",
    "camera_name_mapping": "LeRobot's name of each camera, as JSON.",
    "observation_height": "Height of the policy's pictures, pixels.",
    "observation_width": "Width of the policy's pictures, pixels.",
    "control_mode": "What the policy's actions are: `relative` or `absolute`.",
    "action_mode": "What an action commands: `joint` positions, or `ee` (end-effector) poses.",
}
"""What LeRobot's own env options are, where LeRobot's source does not say it."""


def refuse_unused(config: EnvConfig, base: type[EnvConfig]) -> None:
    """Refuses options that LeRobot's own env has and a scenario settles by itself.

    Args:
        config: what was parsed.
        base: LeRobot's own dataclass.

    Raises:
        OptionError: one of them was given.
    """
    defaults = {f.name: f.default for f in fields(base)}
    for name in SETTLED:
        if name in defaults and getattr(config, name) != defaults[name]:
            raise OptionError(
                f"--env.{name}={getattr(config, name)}: the scenario decides this. "
                "Choose scenarios with --env.select"
            )


def check_quality(quality: str) -> None:
    """Refuses a `render_quality` that MuJoCo platforms do not have.

    Raises:
        OptionError: naming those that there are.
    """
    if quality not in ("full", "fast"):
        raise OptionError(f"--env.render_quality={quality}: not one of full, fast")


def chosen_quality(quality: str) -> dict[str, str]:
    """Left out where it is LeRobot's: trials from before there was a choice keep their identity."""
    return {} if quality == "full" else {"render_quality": quality}


FAST_PICTURES = {"render_quality": "fast"}
"""Of a run whose policy sees no pictures: its videos are for people."""


def without_quality(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a run whose policy sees no pictures: what its videos look like decides nothing."""
    return {name: value for name, value in options.items() if name != "render_quality"}


def drop_pictures(config: EnvConfig) -> None:
    """Leaves out every feature that is a picture."""
    from lerobot.configs import FeatureType

    for key in [k for k, f in config.features.items() if f.type is FeatureType.VISUAL]:
        del config.features[key]


def no_video(_: Observation) -> np.ndarray:
    """Returns a grey frame for a video that was not asked for, unlike any dark scene."""
    return np.full((64, 64, 3), 128, np.uint8)


def first_camera(observation: Observation) -> np.ndarray:
    """The picture of an observation, or of its first camera."""
    pixels = observation["pixels"]
    return next(iter(pixels.values())) if isinstance(pixels, Mapping) else pixels
