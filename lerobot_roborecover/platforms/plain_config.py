"""LeRobot's view of a simulator that observes `agent_pos`, `environment_state` and `pixels`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.base import SimulatorSetup, VideoEnvMixin
from lerobot_roborecover.platforms.env_options import first_camera, no_video

OBS_TYPES = ("state", "pixels_agent_pos")


@dataclass
class StateEnvConfig(EnvConfig, VideoEnvMixin):
    """State vectors, and one square picture where asked for. A platform subclasses it and says how wide."""

    action_width: ClassVar[int]
    """Values in an action."""
    state_widths: ClassVar[Mapping[str, int]]
    """Values of `agent_pos`, and of `environment_state` where there is one."""

    obs_type: str = "state"
    """`state`, which renders nothing, or `pixels_agent_pos`."""
    observation_size: int = 64
    """Side of the picture, pixels."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels": OBS_IMAGE,
        }
    )

    def __post_init__(self):
        kinds = {"agent_pos": FeatureType.STATE, "environment_state": FeatureType.ENV}
        self.features[ACTION] = PolicyFeature(FeatureType.ACTION, (self.action_width,))
        for name, width in self.state_widths.items():
            self.features[name] = PolicyFeature(kinds[name], (width,))
        if self.obs_type == "pixels_agent_pos":
            side = self.observation_size
            self.features["pixels"] = PolicyFeature(FeatureType.VISUAL, (side, side, 3))

    @property
    def gym_kwargs(self) -> dict:
        return {"obs_type": self.obs_type, "observation_size": self.observation_size}

    def simulator_setup(self) -> SimulatorSetup:
        """The options, checked.

        Raises:
            OptionError: one cannot be used.
        """
        if self.obs_type not in OBS_TYPES:
            raise OptionError(f"--env.obs_type={self.obs_type}: not one of {', '.join(OBS_TYPES)}")
        if not 8 <= self.observation_size <= 2048:
            raise OptionError(f"--env.observation_size={self.observation_size}: 8 to 2048 pixels")
        picture = first_camera
        if self.obs_type == "state":
            picture = None if self.videos else no_video
        return SimulatorSetup(self.gym_kwargs, self.gym_kwargs, picture)


def plain_config(action: int, **state: int) -> type[StateEnvConfig]:
    """A platform's configuration.

    Args:
        action: values in an action.
        state: values of `agent_pos` and `environment_state`, by name.
    """
    members = {"action_width": action, "state_widths": state, "__doc__": StateEnvConfig.__doc__}
    return dataclass(type("Config", (StateEnvConfig,), members))
