"""LeRobot's configuration of RoboTwin, and what a recovery run adds to it."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs.configs import RoboTwinEnvConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import OBS_IMAGES

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.base import SimulatorSetup, VideoEnvMixin
from lerobot_roborecover.platforms.env_options import drop_pictures, first_camera, no_video, refuse_unused
from lerobot_roborecover.platforms.robotwin.processors import (
    MOSAIC,
    MOSAIC_SIZE,
    mosaic_processors,
    xvla_processors,
)


@dataclass
class RobotwinConfig(RoboTwinEnvConfig, VideoEnvMixin):
    """Recovery scenarios on RoboTwin 2.0."""

    robotwin_root: str = ""
    """RoboTwin checkout, with its assets; empty: `$ROBOTWIN_ROOT`."""
    render_quality: str = "rt"
    """`rt` (RoboTwin's own ray tracing), `default`, `minimal` or `trivial` (for CPUs). In every trial row;
    scores of different qualities are different experiments."""
    approximate_snapshots: bool = False
    """Start trials from a snapshot of the handoff in place of replaying its prefix. What follows drifts from
    a replay, by up to a millimetre while an object is held; trial rows say so, and are other trials than
    exact ones."""
    control_mode: str = "relative"
    """How `action_mode=ee` actions are read: `relative`, LeRobot's deltas from the poses at the handoff, or
    `absolute`, RoboTwin's own poses (X-VLA)."""
    mosaic: bool = False
    """One picture made of all three cameras, `observation.images.mosaic` (384 x 320), as Fast-WAM was
    trained."""

    def __post_init__(self):
        if self.obs_type == "state":  # joint state alone: renders nothing and needs no Vulkan device
            self.obs_type = "pixels_agent_pos"  # the nearest that LeRobot's own config knows
            super().__post_init__()
            self.obs_type = "state"
            drop_pictures(self)
        else:
            super().__post_init__()
        if self.mosaic:
            drop_pictures(self)
            picture = PolicyFeature(type=FeatureType.VISUAL, shape=(*MOSAIC_SIZE, 3))
            self.features[f"pixels/{MOSAIC}"] = picture
            self.features_map[f"pixels/{MOSAIC}"] = f"{OBS_IMAGES}.{MOSAIC}"

    def processors_for(
        self, policy_cfg: PreTrainedConfig
    ) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """X-VLA's own where it moves end effectors, the env type's otherwise."""
        if getattr(policy_cfg, "type", "") == "xvla" and self.action_mode == "ee":
            return xvla_processors()
        return self.get_env_processors()

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """The mosaic of cameras, where that is asked for."""
        return mosaic_processors() if self.mosaic else super().get_env_processors()

    @property
    def gym_kwargs(self) -> dict:
        ee = {"endpose": True} if self.action_mode == "ee" else {}
        return {
            **ee,
            "robotwin_root": self.robotwin_root or None,
            "camera_names": self.camera_names,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "obs_type": self.obs_type,
            "render_quality": self.render_quality,
            "action_mode": self.action_mode,
        }

    def simulator_setup(self) -> SimulatorSetup:
        """The options, checked.

        Raises:
            OptionError: one cannot be used.
            SimulatorError: there is no RoboTwin checkout, or it lacks the robot.
        """
        from lerobot_roborecover.platforms.robotwin.checkout import RobotwinCheckout
        from lerobot_roborecover.platforms.robotwin.render import QUALITIES
        from lerobot_roborecover.platforms.robotwin.simulator import CAMERA_NAMES
        from lerobot_roborecover.platforms.robotwin.stubs import has_curobo

        refuse_unused(self, RoboTwinEnvConfig)
        if self.render_quality not in QUALITIES:
            raise OptionError(
                f"--env.render_quality={self.render_quality}: not one of {', '.join(QUALITIES)}"
            )
        if self.action_mode not in ("joint", "ee"):
            raise OptionError(f"--env.action_mode={self.action_mode}: not one of joint, ee")
        if self.control_mode not in ("relative", "absolute"):
            raise OptionError(f"--env.control_mode={self.control_mode}: not one of relative, absolute")
        if self.control_mode == "absolute" and self.action_mode == "joint":
            raise OptionError(
                "--env.control_mode=absolute with --env.action_mode=joint: joint targets are "
                "always absolute; use --env.action_mode=ee, or leave control_mode out"
            )
        if self.mosaic and (self.obs_type == "state" or self.camera_names != CAMERA_NAMES):
            raise OptionError(f"--env.mosaic=true: needs pictures of all three cameras ({CAMERA_NAMES})")
        if self.action_mode == "ee" and not has_curobo():
            raise OptionError(
                "--env.action_mode=ee: end-effector actions are planned by curobo, which is not installed"
            )
        if self.obs_type == "state" and self.videos:
            raise OptionError("--env.videos=true with --env.obs_type=state: such scenes cannot be rendered")
        checkout = RobotwinCheckout(self.robotwin_root)
        kwargs = {**self.gym_kwargs, "robotwin_root": str(checkout.root)}
        decisive = {k: v for k, v in kwargs.items() if k != "robotwin_root"}
        decisive["robotwin_robot"] = checkout.robot_hash
        if self.obs_type == "state":
            decisive["render_quality"] = "none"
        if self.action_mode == "ee":
            decisive["control_mode"] = self.control_mode
        if self.mosaic:
            decisive["mosaic"] = True
        if self.approximate_snapshots:
            decisive["approximate_snapshots"] = True
        assets = {
            "robotwin_code": checkout.code_hash,
            "robotwin_robot": checkout.robot_hash,
            **checkout.robot.fingerprint,
        }
        assets |= {f"robotwin_task.{name}": checkout.task_hash(name) for name in checkout.step_limits}
        return SimulatorSetup(
            kwargs,
            decisive,
            picture=no_video if self.obs_type == "state" else first_camera,
            assets=assets,
            # LeRobot's end-effector actions are deltas; recorded prefixes are absolute poses.
            control_mode=self.control_mode if self.action_mode == "ee" else None,
            approximate_snapshots=self.approximate_snapshots,
        )
