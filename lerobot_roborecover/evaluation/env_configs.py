"""The env types `lerobot-eval` knows: each platform's own LeRobot config, plus the recovery options.

Observations, features, processors and action space are those of the platform's config, which inherits them
from LeRobot's own (`LiberoEnv`, `MetaworldEnv`, `RoboTwinEnvConfig`), so a checkpoint that runs on those runs
here unchanged.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.lerobot_introspection import (
    choose_processors_in_scripts,
    metadata_of_caller,
)
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec
from lerobot_roborecover.evaluation.vector_env import ScenarioVectorEnv, create_recovery_envs
from lerobot_roborecover.platforms import Platform, all_platforms, platform_named
from lerobot_roborecover.platforms.base import SimulatorSetup
from lerobot_roborecover.platforms.registry import ENV_PREFIX, env_type_of
from lerobot_roborecover.workers.messages import SlotConfig

_LOG = logging.getLogger(__name__)


if TYPE_CHECKING:

    class _PlatformsOwn(EnvConfig):
        """What the platform's config, which is the other base of every env type, is sure to have."""

        obs_type: str

        def simulator_setup(self) -> SimulatorSetup: ...
else:
    _PlatformsOwn = object  # a base here would put its fields' defaults before the platform's


@dataclass
class RecoveryEnvConfig(RecoveryOptions, _PlatformsOwn):
    """What all recovery env types share. Comes before the platform's own config."""

    max_parallel_tasks: int = 1
    """Must stay 1."""
    platform_name: ClassVar[str] = ""

    def processors_for(self, policy_cfg: Any) -> tuple[Any, Any] | None:
        """Env processors for a policy; None leaves the choice to LeRobot, which gives X-VLA LIBERO's."""
        own = getattr(super(), "processors_for", None)
        return self.get_env_processors() if own is None else own(policy_cfg)

    @property
    def has_pictures(self) -> bool:
        """Whether a policy sees any."""
        return any(feature.type is FeatureType.VISUAL for feature in self.features.values())

    def run_spec(self, *, with_videos: bool = False) -> SimulatorSpec:
        """The platform's part of a run, checked.

        Args:
            with_videos: the run keeps videos.

        Raises:
            OptionError: an option cannot be used.
            SimulatorError: assets, or a checkout, are missing.
        """
        if self.max_parallel_tasks != 1:
            raise OptionError(
                f"--env.max_parallel_tasks={self.max_parallel_tasks}: must be 1. LeRobot would share one "
                "policy, and its action queue, between threads (huggingface/lerobot#4327)"
            )
        setup = self.simulator_setup()
        slot = SlotConfig(
            setup.platform or self.platform_name,
            {**setup.options, **(setup.video_options if with_videos else {})},
            approximate_snapshots=setup.approximate_snapshots,
            control_mode=setup.control_mode,
        )
        return SimulatorSpec(slot, setup.decisive, setup.picture, setup.assets)

    # LeRobot's annotation has numbers for task ids; its loops only sort and print them.
    def create_envs(  # ty: ignore[incompatible-method-override]
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[str, ScenarioVectorEnv]]:
        """`{group: {scenario id: vector env}}`; raises what `run_spec` and `session.create_session` raise."""
        choose_processors_in_scripts()
        return create_recovery_envs(
            self, self.run_spec(), n_envs=n_envs, workers=use_async_envs, facts=metadata_of_caller(self)
        )


def _env_type(platform: Platform) -> type[RecoveryEnvConfig]:
    base = platform.env_config()
    name = f"RoboRecover{platform.name.capitalize()}Env"
    members = {"__module__": __name__, "__doc__": base.__doc__, "platform_name": platform.name}
    made = dataclass(type(name, (RecoveryEnvConfig, base), members))
    EnvConfig.register_subclass(env_type_of(platform.name))(
        made
    )  # the first is the type that it names itself
    EnvConfig.register_subclass(f"{ENV_PREFIX}{platform.name}")(made)
    return made


def _register_all() -> tuple[dict[str, type[RecoveryEnvConfig]], dict[str, str]]:
    found, unusable = {}, {}
    for platform in all_platforms():
        if platform.env_name:
            continue  # another's env type serves it
        try:
            found[platform.name] = _env_type(platform)
        except Exception as err:  # a third-party platform must not break LeRobot's programs
            unusable[platform.name] = f"{type(err).__name__}: {err}"
            _LOG.warning("platform %r has no usable env config: %s", platform.name, unusable[platform.name])
    return found, unusable


ENV_TYPES, _UNUSABLE = _register_all()
"""By platform's name: its env type."""


def env_type(platform: str) -> type[RecoveryEnvConfig]:
    """The env type of a platform.

    Raises:
        OptionError: it has none that is usable; says why.
        ScenarioError: there is no such platform.
    """
    if platform not in ENV_TYPES:
        found = platform_named(platform)
        name = found.env_name or found.name
        if name in ENV_TYPES:
            return ENV_TYPES[name]
        raise OptionError(
            f"--env.type={env_type_of(name)}: the platform's env config is not usable: "
            f"{_UNUSABLE.get(name, 'it was registered after the plugin was imported')}"
        )
    return ENV_TYPES[platform]
