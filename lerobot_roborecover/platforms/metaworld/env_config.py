"""LeRobot's configuration of Meta-World, and what a recovery run adds to it."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import MetaworldEnv
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_roborecover.platforms.base import SimulatorSetup, VideoEnvMixin
from lerobot_roborecover.platforms.env_options import (
    FAST_PICTURES,
    check_quality,
    chosen_quality,
    first_camera,
    no_video,
    refuse_unused,
    without_quality,
)


@dataclass
class MetaworldConfig(MetaworldEnv, VideoEnvMixin):
    """Recovery scenarios on Meta-World."""

    observation_height: int = 480
    observation_width: int = 480
    render_quality: str = "full"
    """`full`, as LeRobot renders; or `fast`, without shadows and smoothing, some six times as fast where
    there is no GPU. Other pictures, so another experiment for a policy that looks at them; videos that
    `roborecover eval` keeps of one that does not are always `fast`."""
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(4,))}
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "top": OBS_IMAGE,
            "pixels/top": OBS_IMAGE,
        }
    )

    def __post_init__(self):
        if self.obs_type == "state":
            self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=(4,))
            self.features["environment_state"] = PolicyFeature(type=FeatureType.ENV, shape=(39,))
        else:
            super().__post_init__()
            for key, feature in list(self.features.items()):
                if feature.type is FeatureType.VISUAL:
                    shape = (self.observation_height, self.observation_width, 3)
                    self.features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)

    @property
    def gym_kwargs(self) -> dict:
        return {
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "obs_type": self.obs_type,
            **chosen_quality(self.render_quality),
        }

    def simulator_setup(self) -> SimulatorSetup:
        """The options, checked.

        Raises:
            OptionError: one cannot be used.
        """
        refuse_unused(self, MetaworldEnv)
        check_quality(self.render_quality)
        picture = first_camera
        decisive, for_videos = self.gym_kwargs, {}
        if self.obs_type == "state":
            picture = None if self.videos else no_video
            decisive, for_videos = without_quality(decisive), FAST_PICTURES
        return SimulatorSetup(self.gym_kwargs, decisive, picture, video_options=for_videos)
