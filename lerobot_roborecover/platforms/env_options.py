"""What the env configs of several platforms share: refusals, render quality, and frames of observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.simulator import Observation

if TYPE_CHECKING:
    from lerobot.envs.configs import EnvConfig


def refuse_unused(config: EnvConfig, base: type[EnvConfig], names: tuple[str, ...]) -> None:
    """Refuses options that LeRobot's own env has and a scenario settles by itself.

    Args:
        config: what was parsed.
        base: LeRobot's own dataclass.
        names: of its options.

    Raises:
        OptionError: one of them was given.
    """
    defaults = {f.name: f.default for f in fields(base)}
    for name in names:
        if getattr(config, name) != defaults[name]:
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


def no_video(_: Observation) -> np.ndarray:
    """Returns a grey frame for a video that was not asked for, unlike any dark scene."""
    return np.full((64, 64, 3), 128, np.uint8)


def first_camera(observation: Observation) -> np.ndarray:
    """The picture of an observation, or of its first camera."""
    pixels = observation["pixels"]
    return next(iter(pixels.values())) if isinstance(pixels, Mapping) else pixels
