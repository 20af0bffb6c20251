"""LeRobot's configuration of LIBERO, and what a recovery run adds to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs.configs import LiberoEnv
from lerobot.processor.env_processor import LiberoProcessorStep
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.base import SimulatorSetup, VideoEnvMixin
from lerobot_roborecover.platforms.env_options import (
    FAST_PICTURES,
    check_quality,
    chosen_quality,
    drop_pictures,
    first_camera,
    no_video,
    refuse_unused,
    without_quality,
)
from lerobot_roborecover.platforms.libero.goal_state import ENVIRONMENT_STATE_DIM

_ROBOT_STATE = "robot_state/"
_FAST_PICTURES = 2
"""Of how `fast` draws (`fast.py`, `decimation.py`); another number where pictures change, so that no log
mixes them."""


@dataclass
class LiberoConfig(LiberoEnv, VideoEnvMixin):
    """Recovery scenarios on LIBERO."""

    assets_dir: str = ""
    """LIBERO's asset folder; empty: `$ROBORECOVER_LIBERO_ASSETS`, LIBERO's own configuration, then the
    Hub."""
    render_quality: str = "full"
    """`full`, as LeRobot renders; or `fast`, without shadows, reflections and smoothing and with coarser
    meshes, at a tenth of the cost or so where there is no GPU. Other pictures, so another experiment for a
    policy that looks at them; the physics is the same. Videos that `roborecover eval` keeps of one that does
    not are always `fast`."""

    def processors_for(self, policy_cfg: PreTrainedConfig) -> None:
        """LeRobot's choice is right here."""

    def __post_init__(self):
        if self.obs_type == "state":  # robot and environment state, for policies that look at nothing
            self.obs_type = "pixels_agent_pos"  # the nearest that LeRobot's own config knows
            super().__post_init__()
            self.obs_type = "state"
            drop_pictures(self)
            self.features["environment_state"] = PolicyFeature(FeatureType.ENV, (ENVIRONMENT_STATE_DIM,))
            self.features_map["environment_state"] = OBS_ENV_STATE
        else:
            super().__post_init__()
        _join_robot_state(self)

    @property
    def gym_kwargs(self) -> dict:
        return {
            "assets_dir": self.assets_dir or None,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "camera_name": self.camera_name,
            "camera_name_mapping": self.camera_name_mapping,
            "obs_type": self.obs_type,
            "fps": self.fps,
            **chosen_quality(self.render_quality),
        }

    def simulator_setup(self) -> SimulatorSetup:
        """The options, checked.

        Raises:
            OptionError: one cannot be used.
            SimulatorError: LIBERO's assets are missing.
        """
        from lerobot_roborecover.platforms.libero.assets import find_assets, physics_hash

        refuse_unused(self, LiberoEnv)
        check_quality(self.render_quality)
        if self.fps != 20:
            raise OptionError(f"--env.fps={self.fps}: recorded prefixes are of 20 Hz")
        if self.control_mode not in ("relative", "absolute"):
            raise OptionError(f"--env.control_mode={self.control_mode}: not one of ['relative', 'absolute']")
        assets = find_assets(self.assets_dir or None)
        options = {**self.gym_kwargs, "assets_dir": str(assets)}
        decisive = {k: v for k, v in options.items() if k != "assets_dir"}
        if self.render_quality == "fast" and self.obs_type != "state":
            decisive["fast_pictures"] = _FAST_PICTURES
        picture, for_videos = _upright, {}
        if self.obs_type == "state":
            picture = None if self.videos else no_video
            decisive, for_videos = without_quality(decisive), FAST_PICTURES
        return SimulatorSetup(
            options,
            decisive | {"control_mode": self.control_mode},
            picture,
            assets={"libero_assets": physics_hash(assets)},
            control_mode=self.control_mode,
            video_options=for_videos,
        )


def _join_robot_state(config: LiberoEnv) -> None:
    """Names the robot's state as policies get it. LeRobot's features name its parts; LIBERO's env processor
    makes one vector of them, and no policy sees a part."""
    parts = [key for key in config.features if key.startswith(_ROBOT_STATE)]
    for key in parts:
        del config.features[key]
    if parts:
        given = LiberoProcessorStep().transform_features({})
        config.features[OBS_STATE] = given[FeatureType.STATE][OBS_STATE]  # ty: ignore[invalid-argument-type]
        config.features_map[OBS_STATE] = OBS_STATE


def _upright(observation: dict[str, Any]) -> np.ndarray:
    return first_camera(observation)[::-1, ::-1]
