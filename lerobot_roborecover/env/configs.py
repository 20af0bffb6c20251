"""The env types `lerobot-eval` knows: LeRobot's own config of each platform, plus the recovery options.

Observations, features, processors and action space are inherited from LeRobot's `LiberoEnv`,
`MetaworldEnv` and `RoboTwinEnvConfig`, so a checkpoint that runs on those runs here unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, LiberoEnv, MetaworldEnv, RoboTwinEnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE

from lerobot_roborecover.env.episode import SlotConfig
from lerobot_roborecover.env.options import OptionError, RecoveryOptions
from lerobot_roborecover.env.processors import choose_processors_in_scripts
from lerobot_roborecover.env.robotwin_processors import (
    MOSAIC,
    MOSAIC_SIZE,
    mosaic_processors,
    xvla_processors,
)
from lerobot_roborecover.env.run import RunSpec, create_recovery_envs


def _refuse_unused(config: EnvConfig, base: type[EnvConfig], names: tuple[str, ...]) -> None:
    """Refuses options that LeRobot's own env has and a scenario settles by itself."""
    defaults = {f.name: f.default for f in fields(base)}
    for name in names:
        if getattr(config, name) != defaults[name]:
            raise OptionError(
                f"--env.{name}={getattr(config, name)}: the scenario decides this. "
                "Choose scenarios with --env.select"
            )


def _check_parallel(config: EnvConfig) -> None:
    if config.max_parallel_tasks != 1:
        raise OptionError(
            f"--env.max_parallel_tasks={config.max_parallel_tasks}: must be 1. LeRobot would share one "
            "policy, and its action queue, between threads (huggingface/lerobot#4327)"
        )


def _no_video(_: dict) -> np.ndarray:
    """Frame of a video nobody asked for: grey, so that it is not mistaken for a dark scene."""
    return np.full((64, 64, 3), 128, np.uint8)


def _pixels(observation: dict) -> np.ndarray:
    return observation["pixels"]


def _drop_pictures(config: EnvConfig) -> None:
    for key in [k for k, f in config.features.items() if f.type is FeatureType.VISUAL]:
        del config.features[key]


@dataclass
class _RecoveryEnvConfig(RecoveryOptions):
    """What all recovery env types share; each adds its `run_spec`. Comes before LeRobot's own config."""

    def processors_for(self, policy_cfg: Any) -> tuple[Any, Any] | None:
        """Env processors for a policy; None leaves the choice to LeRobot, which gives X-VLA LIBERO's."""
        return self.get_env_processors()

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[str, gym.vector.VectorEnv]]:
        """`{group: {scenario id: vector env}}`; raises what `run_spec` and `env.run.open_run` raise."""
        choose_processors_in_scripts()
        return create_recovery_envs(self, self.run_spec(), n_envs=n_envs, workers=use_async_envs)


@EnvConfig.register_subclass("roborecover_libero")
@dataclass
class RoboRecoverLiberoEnv(_RecoveryEnvConfig, LiberoEnv):
    """Recovery scenarios on LIBERO."""

    assets_dir: str = ""
    """LIBERO's asset folder; empty: `$ROBORECOVER_LIBERO_ASSETS`, LIBERO's own configuration, then the
    Hub."""
    max_parallel_tasks: int = 1

    def processors_for(self, policy_cfg: Any) -> None:
        """LeRobot's choice is right here."""

    def __post_init__(self):
        if self.obs_type == "state":  # robot state alone, for policies that look at nothing
            self.obs_type = "pixels_agent_pos"  # the nearest that LeRobot's own config knows
            super().__post_init__()
            self.obs_type = "state"
            _drop_pictures(self)
        else:
            super().__post_init__()

    @property
    def gym_kwargs(self) -> dict:
        """Options of the simulator."""
        return {
            "assets_dir": self.assets_dir or None,
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "camera_name": self.camera_name,
            "camera_name_mapping": self.camera_name_mapping,
            "obs_type": self.obs_type,
            "fps": self.fps,
        }

    def run_spec(self) -> RunSpec:
        """The platform's part of a run, checked.

        Raises:
            OptionError: an option cannot be used.
            SimulatorError: LIBERO's assets are missing.
        """
        from lerobot_roborecover.simulators.libero_assets import find_assets, physics_hash

        _refuse_unused(
            self,
            LiberoEnv,
            ("task", "task_ids", "init_states", "hard_reset", "is_libero_plus", "episode_length"),
        )
        _check_parallel(self)
        if self.fps != 20:
            raise OptionError(f"--env.fps={self.fps}: recorded prefixes are of 20 Hz")
        if self.control_mode not in ("relative", "absolute"):
            raise OptionError(f"--env.control_mode={self.control_mode}: not one of ['relative', 'absolute']")
        assets = find_assets(self.assets_dir or None)
        kwargs = {**self.gym_kwargs, "assets_dir": str(assets)}
        decisive = {k: v for k, v in kwargs.items() if k != "assets_dir"} | {
            "control_mode": self.control_mode
        }
        return RunSpec(
            SlotConfig("libero", kwargs, control_mode=self.control_mode),
            decisive,
            picture=_no_video if self.obs_type == "state" and not self.videos else self._picture(),
            assets={"libero_assets": physics_hash(assets)},
        )

    def _picture(self):
        if self.obs_type == "state":
            return None

        def upright(observation: dict[str, Any]) -> np.ndarray:
            return next(iter(observation["pixels"].values()))[::-1, ::-1]

        return upright


@EnvConfig.register_subclass("roborecover_metaworld")
@dataclass
class RoboRecoverMetaworldEnv(_RecoveryEnvConfig, MetaworldEnv):
    """Recovery scenarios on Meta-World."""

    observation_height: int = 480
    observation_width: int = 480
    render_quality: str = "full"
    """`full`, as LeRobot renders; or `fast`, without shadows and smoothing, some six times as fast where
    there is no GPU. Other pictures, so another experiment for a policy that looks at them."""
    max_parallel_tasks: int = 1
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
        """Options of the simulator."""
        return {
            "observation_height": self.observation_height,
            "observation_width": self.observation_width,
            "obs_type": self.obs_type,
            **({} if self.render_quality == "full" else {"render_quality": self.render_quality}),
        }

    def run_spec(self) -> RunSpec:
        """The platform's part of a run, checked.

        Raises:
            OptionError: an option cannot be used.
        """
        _refuse_unused(self, MetaworldEnv, ("task", "episode_length", "multitask_eval"))
        if self.render_quality not in ("full", "fast"):
            raise OptionError(f"--env.render_quality={self.render_quality}: not one of full, fast")
        _check_parallel(self)
        picture = _no_video if self.obs_type == "state" and not self.videos else None
        if self.obs_type != "state":
            picture = _pixels
        return RunSpec(SlotConfig("metaworld", self.gym_kwargs), self.gym_kwargs, picture)


def _first_camera(observation: dict) -> np.ndarray:
    return next(iter(observation["pixels"].values()))


@EnvConfig.register_subclass("roborecover_robotwin")
@dataclass
class RoboRecoverRobotwinEnv(_RecoveryEnvConfig, RoboTwinEnvConfig):
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
    max_parallel_tasks: int = 1

    def __post_init__(self):
        if self.obs_type == "state":  # joint state alone: renders nothing and needs no Vulkan device
            self.obs_type = "pixels_agent_pos"  # the nearest that LeRobot's own config knows
            super().__post_init__()
            self.obs_type = "state"
            _drop_pictures(self)
        else:
            super().__post_init__()
        if self.mosaic:
            _drop_pictures(self)
            picture = PolicyFeature(type=FeatureType.VISUAL, shape=(*MOSAIC_SIZE, 3))
            self.features[f"pixels/{MOSAIC}"] = picture
            self.features_map[f"pixels/{MOSAIC}"] = f"{OBS_IMAGES}.{MOSAIC}"

    def processors_for(self, policy_cfg: Any) -> tuple[Any, Any]:
        """X-VLA's own where it moves end effectors, the env type's otherwise."""
        if getattr(policy_cfg, "type", "") == "xvla" and self.action_mode == "ee":
            return xvla_processors()
        return self.get_env_processors()

    def get_env_processors(self) -> tuple[Any, Any]:
        """The mosaic of cameras, where that is asked for."""
        return mosaic_processors() if self.mosaic else super().get_env_processors()

    @property
    def gym_kwargs(self) -> dict:
        """Options of the simulator."""
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

    def run_spec(self) -> RunSpec:
        """The platform's part of a run, checked.

        Raises:
            OptionError: an option cannot be used.
            SimulatorError: there is no RoboTwin checkout, or it lacks the robot.
        """
        from lerobot_roborecover.simulators.robotwin import CAMERA_NAMES
        from lerobot_roborecover.simulators.robotwin_checkout import RobotwinCheckout
        from lerobot_roborecover.simulators.robotwin_render import QUALITIES
        from lerobot_roborecover.simulators.robotwin_stubs import has_curobo

        _refuse_unused(self, RoboTwinEnvConfig, ("task", "episode_length"))
        _check_parallel(self)
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
        assets = {"robotwin_code": checkout.code_hash, "robotwin_robot": checkout.robot_hash}
        assets |= {f"robotwin_task.{name}": checkout.task_hash(name) for name in checkout.step_limits}
        return RunSpec(
            # LeRobot's end-effector actions are deltas; recorded prefixes are absolute poses.
            SlotConfig(
                "robotwin",
                kwargs,
                approximate_snapshots=self.approximate_snapshots,
                control_mode=self.control_mode if self.action_mode == "ee" else None,
            ),
            decisive,
            picture=_no_video if self.obs_type == "state" else _first_camera,
            assets=assets,
        )


@EnvConfig.register_subclass("roborecover_fake")
@dataclass
class RoboRecoverFakeEnv(_RecoveryEnvConfig, EnvConfig):
    """Recovery scenarios on the point-mass simulator: for trying the machinery, not for scores."""

    obs_type: str = "state"
    step_s: float = 0.0
    max_parallel_tasks: int = 1
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(4,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(6,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels": OBS_IMAGE,
        }
    )

    def __post_init__(self):
        if self.obs_type == "pixels_agent_pos":
            self.features["pixels"] = PolicyFeature(type=FeatureType.VISUAL, shape=(32, 32, 3))

    @property
    def gym_kwargs(self) -> dict:
        """Options of the simulator."""
        return {"obs_type": self.obs_type, "step_s": self.step_s}

    def run_spec(self) -> RunSpec:
        """The platform's part of a run."""
        _check_parallel(self)
        picture = None if self.obs_type == "state" and self.videos else _no_video
        return RunSpec(SlotConfig("fake", self.gym_kwargs), {"obs_type": self.obs_type}, picture)
