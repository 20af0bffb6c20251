"""LeRobot's configuration of any env type, inside that of a recovery run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import draccus
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, HubEnvConfig, PushtEnv
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms.base import SimulatorSetup, VideoEnvMixin
from lerobot_roborecover.platforms.env_options import no_video
from lerobot_roborecover.platforms.lerobot.known import KNOWN
from lerobot_roborecover.platforms.lerobot.platform import DEFAULT_TYPE, HUB_TYPE, member_name
from lerobot_roborecover.platforms.lerobot.source import EnvSource, check_hub
from lerobot_roborecover.platforms.registry import ENV_PREFIX
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.utils.plugins import register_plugins

_NOT_SIMULATED = ("gym_manipulator",)
"""Env types that are real robots: nothing of theirs can be replayed."""


@dataclass
class EnvHubConfig(HubEnvConfig):
    """An environment on the Hub, made by the `make_env` of its `env.py`."""

    episode_length: int = 300
    """Steps of a trial."""


class BaseEnvConfig(draccus.ChoiceRegistry):
    """The env types that can be a base: LeRobot's and third parties', and `hub`; none of ours."""

    @classmethod
    def default_choice_name(cls) -> str:
        return DEFAULT_TYPE

    @classmethod
    def get_known_choices(cls) -> dict[str, Any]:
        register_plugins()
        every = EnvConfig.get_known_choices()
        ours = {n: c for n, c in every.items() if not n.startswith(ENV_PREFIX) and n not in _NOT_SIMULATED}
        return {HUB_TYPE: EnvHubConfig, **ours}

    @classmethod
    def get_choice_class(cls, name: str) -> Any:
        """Its class; raises `KeyError`. A type is also known by what a platform's name has of it."""
        choices = cls.get_known_choices()
        return choices.get(name) or {member_name(n): c for n, c in choices.items()}[member_name(name)]

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """Its name; raises `ValueError`."""
        return HUB_TYPE if subcls is EnvHubConfig else EnvConfig.get_choice_name(subcls)


def base_types() -> Iterable[str]:
    """Names of the env types that can be a base, those of installed plugins among them."""
    return BaseEnvConfig.get_known_choices()


def default_base(env_type: str) -> EnvConfig:
    """An env type's configuration as LeRobot makes it.

    Raises:
        OptionError: it needs options.
    """
    try:
        return BaseEnvConfig.get_choice_class(env_type)()
    except Exception as err:  # a third-party configuration may raise anything
        raise OptionError(f"--env.base.type={env_type}: {type(err).__name__}: {err!s:.300}") from err


def source_of(base: EnvConfig) -> EnvSource:
    """Where the environment of a configuration comes from; the light way, if LeRobot's default makes it."""
    if isinstance(base, HubEnvConfig):
        return EnvSource(hub=base.hub_path or "")
    if type(base).create_envs is EnvConfig.create_envs:
        package, _, task = base.gym_id.rpartition("/")
        if package == base.package_name and task == base.task:
            return EnvSource(package=package, kwargs=dict(base.gym_kwargs))
    encoded = draccus.encode(base)
    return EnvSource(config={**_plain(encoded), "type": BaseEnvConfig.get_choice_name(type(base))})


def _plain(encoded: Any) -> dict[str, Any]:
    """Without features, which LeRobot's config makes anew."""
    return {k: v for k, v in encoded.items() if k not in ("features", "features_map")}


if TYPE_CHECKING:
    _Base = EnvConfig
else:
    _Base = BaseEnvConfig  # what draccus chooses from: the env types, without those of ours


def _pusht() -> EnvConfig:
    return PushtEnv(obs_type=KNOWN["pusht"].kwargs["obs_type"])


@dataclass
class LeRobotConfig(EnvConfig, VideoEnvMixin):
    """Recovery scenarios on any env type of LeRobot's."""

    base: _Base = field(default_factory=_pusht)
    """The env type, `--env.base.type=NAME`, and its own options, `--env.base.OPTION=VALUE`."""
    obs_type: str = ""
    """In place of the base's own; `state` stands for what it has without pictures."""
    success_key: str = "is_success"
    """Of a step's info: the environment's own answer, where it is called otherwise. In every trial row."""
    trust_remote_code: bool = False
    """Run the code of `--env.base.type=hub --env.base.hub_path=user/name@commit`."""

    def __post_init__(self):
        if self.obs_type:
            self.base = self._with_obs_type(self.obs_type)
        self._problem = self._ask_the_environment() if isinstance(self.base, HubEnvConfig) else ""
        self.obs_type = _kind_of(self.base)
        self.task, self.fps = self.base.task, self.base.fps
        self.features, self.features_map = self.base.features, self.base.features_map

    def _with_obs_type(self, wanted: str) -> Any:
        name = BaseEnvConfig.get_choice_name(type(self.base))
        if not hasattr(self.base, "obs_type"):
            if wanted == "state":
                return self.base  # it has one kind alone
            raise OptionError(f"--env.obs_type={wanted}: env type {name} has one kind of observation alone")
        if wanted == "state":
            wanted = str(KNOWN[name].kwargs["obs_type"]) if name in KNOWN else wanted
        values = _plain(draccus.encode(self.base)) | {"obs_type": wanted}
        try:
            return draccus.decode(BaseEnvConfig, {**values, "type": name})
        except Exception as err:
            raise OptionError(f"--env.obs_type={wanted}: env type {name}: {err!s:.200}") from None

    def _ask_the_environment(self) -> str:
        """A repository on the Hub says nothing of its features; its environment does.

        Returns:
            Why it could not be asked. LeRobot's parser hides what is raised while it parses.
        """
        from lerobot_roborecover.platforms.lerobot.source import make_env

        assert isinstance(self.base, HubEnvConfig)
        if self.base.features:
            return ""
        try:
            self._check_hub()
            env = make_env(source_of(self.base), self.base.task or "")
        except (OptionError, SimulatorError) as err:
            return str(err)
        try:
            space, acts = env.observation_space, env.action_space
            shape = acts.shape or ()
            features, names = {ACTION: PolicyFeature(FeatureType.ACTION, shape)}, {ACTION: ACTION}
            spaces = getattr(space, "spaces", {})
            for key, kind, name in (
                ("agent_pos", FeatureType.STATE, OBS_STATE),
                ("environment_state", FeatureType.ENV, OBS_ENV_STATE),
            ):
                if key in spaces:
                    features[key], names[key] = PolicyFeature(kind, spaces[key].shape), name
            pixels = spaces.get("pixels")
            for key, part in getattr(pixels, "spaces", {"": pixels} if pixels is not None else {}).items():
                label = f"pixels/{key}" if key else "pixels"
                features[label] = PolicyFeature(FeatureType.VISUAL, part.shape)
                names[label] = f"{OBS_IMAGES}.{key}" if key else OBS_IMAGE
        finally:
            env.close()
        self.base.features, self.base.features_map = features, names
        return ""

    def _check_hub(self) -> None:
        assert isinstance(self.base, HubEnvConfig)
        try:
            check_hub(self.base.hub_path or "")
        except SimulatorError as err:
            raise OptionError(f"--env.base.hub_path: {err}") from None
        if not self.trust_remote_code:
            raise OptionError(
                f"--env.base.hub_path={self.base.hub_path}: its code would run here. Read it, and say "
                "--env.trust_remote_code=true"
            )

    @property
    def gym_kwargs(self) -> dict:
        """Options of the simulator, and the horizon of its tasks."""
        return {**self._options(), "horizon": getattr(self.base, "episode_length", None)}

    def _options(self) -> dict[str, Any]:
        source = source_of(self.base).as_options()
        known = {"source": source, "task": self.base.task or "", "control_hz": float(self.base.fps)}
        return known | ({} if self.success_key == "is_success" else {"success_key": self.success_key})

    def get_env_processors(self) -> tuple[Any, Any]:
        return self.base.get_env_processors()

    def simulator_setup(self) -> SimulatorSetup:
        """The options, checked.

        Raises:
            OptionError: one cannot be used.
        """
        if isinstance(self.base, HubEnvConfig):
            self._check_hub()
        if self._problem:
            raise OptionError(f"--env.base: {self._problem}")
        kwargs = self._options()
        picture = no_video if self.obs_type == "state" and not self.videos else None
        kind = BaseEnvConfig.get_choice_name(type(self.base))
        if set(self.features) <= {ACTION}:
            raise OptionError(
                f"--env.base.obs_type={getattr(self.base, 'obs_type', '')}: with it, env type {kind} gives a "
                "policy nothing to see"
            )
        decisive = {**kwargs, "env_type": kind}
        return SimulatorSetup(kwargs, decisive, picture, platform=member_name(kind))


def _kind_of(base: EnvConfig) -> str:
    pictures = any(f.type is FeatureType.VISUAL for f in base.features.values())
    return str(getattr(base, "obs_type", "")) or "pixels_agent_pos" if pictures else "state"
