"""Small changes to the features of LeRobot's env configurations. Imports LeRobot."""

from __future__ import annotations

from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig


def drop_pictures(config: EnvConfig) -> None:
    """Leaves out every feature that is a picture."""
    for key in [k for k, f in config.features.items() if f.type is FeatureType.VISUAL]:
        del config.features[key]
