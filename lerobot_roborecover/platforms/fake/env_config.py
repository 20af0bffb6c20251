"""LeRobot's view of the point mass."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_roborecover.platforms.base import SimulatorSetup
from lerobot_roborecover.platforms.env_options import no_video
from lerobot_roborecover.platforms.plain_config import StateEnvConfig


@dataclass
class FakeConfig(StateEnvConfig):
    """Recovery scenarios on the point-mass simulator: for trying the machinery, not for scores."""

    action_width = 2
    state_widths = {"agent_pos": 4, "environment_state": 6}  # noqa: RUF012 - declared as ClassVar

    observation_size: int = 32
    """Side of the picture, pixels."""
    step_s: float = 0.0
    """Wall time of a step, seconds."""

    @property
    def gym_kwargs(self) -> dict:
        return {**super().gym_kwargs, "step_s": self.step_s}

    def simulator_setup(self) -> SimulatorSetup:
        """The simulator refuses what it cannot use; its pictures are no videos."""
        picture = None if self.obs_type == "state" and self.videos else no_video
        return SimulatorSetup(self.gym_kwargs, {"obs_type": self.obs_type}, picture)
