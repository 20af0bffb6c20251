"""Where a Gymnasium environment comes from, as plain JSON that travels to a worker; and how it is made."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium as gym

from lerobot_roborecover.platforms.catalog import nearest
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.utils.text import install_command

_PINNED = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}(:[\w./-]+\.py)?")


@dataclass(frozen=True)
class EnvSource:
    """One of three ways to an environment; only the first needs no LeRobot in the worker."""

    package: str = ""
    """Module whose import registers `<package>/<task>`."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Kwargs of `gymnasium.make`."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """A LeRobot `EnvConfig` as draccus encodes it, `type` among it, whose `create_envs` makes the env."""
    hub: str = ""
    """An environment on the Hub, `user/name@commit` and `:file.py` where it is not `env.py`. Its code is
    executed."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> EnvSource:
        """From the plain values of `as_options`."""
        return cls(**options)

    @property
    def name(self) -> str:
        """A task's, where the environment has none."""
        return self.hub.partition("@")[0].replace("/", ".") or str(self.config.get("type", ""))

    def as_options(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if value}


def check_hub(path: str) -> None:
    """Refuses an environment on the Hub whose code could change.

    Raises:
        SimulatorError: it names no commit.
    """
    if not _PINNED.fullmatch(path):
        raise SimulatorError(
            f"environment {path!r:.160} of the Hub is not user/name@commit (40 hex digits; and :file.py, "
            "where it is not env.py). A branch moves: name the commit whose code you have read"
        )


def make_env(source: EnvSource, task: str) -> gym.Env:
    """Makes an environment that no time limit ends.

    Args:
        source: where from.
        task: its name; of the first way the Gymnasium id's second half, of the others `<group>.<task id>`.

    Raises:
        SimulatorError: it cannot be imported or made.
    """
    try:
        env = (_registered if source.package else _of_lerobot)(source, task)
    except SimulatorError:
        raise
    except Exception as err:  # a third-party environment may raise anything
        raise SimulatorError(
            f"task {task!r:.120} cannot be made: {type(err).__name__}: {err!s:.400}"
        ) from err
    layer = env
    while isinstance(layer, gym.Wrapper):
        if isinstance(layer, gym.wrappers.TimeLimit):
            layer._max_episode_steps = sys.maxsize
        layer = layer.env
    return env


def registered_tasks(package: str) -> list[str]:
    """Names of the Gymnasium ids that a package registers, which is imported."""
    _import(package)
    head = f"{package}/"
    return sorted(name.removeprefix(head) for name in gym.registry if name.startswith(head))


def _import(package: str) -> None:
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as err:
        if err.name != package:
            raise
        raise SimulatorError(
            f"the package {package!r} of this env type is not installed. Install it: for LeRobot's own, "
            f"{install_command('gym')}"
        ) from None


def _registered(source: EnvSource, task: str) -> gym.Env:
    name = f"{source.package}/{task}"
    if name not in gym.registry:
        there = registered_tasks(source.package)
        if task not in there:
            known = nearest(task, set(there)) if there else ""
            raise SimulatorError(f"{source.package} registers no task {task!r:.120}{known}")
    options: dict[str, Any] = {"disable_env_checker": True, **source.kwargs, "max_episode_steps": -1}
    return gym.make(name, **options)


def _of_lerobot(source: EnvSource, task: str) -> gym.Env:
    from lerobot.envs.factory import make_env as lerobots

    if source.hub:
        check_hub(source.hub)
        made = lerobots(source.hub, n_envs=1, trust_remote_code=True)
    else:
        made = lerobots(decode_config(source.config), n_envs=1)
    found = {f"{group}.{number}": vector for group, per in made.items() for number, vector in per.items()}
    only = next(iter(found.values())) if len(found) == 1 else None
    vector = found.get(task, only)
    if vector is None:
        raise SimulatorError(f"there is no task {task!r:.120}; there are {', '.join(sorted(found))}")
    for other in found.values():
        if other is not vector:
            other.close()
    envs = getattr(vector, "envs", None)
    if not envs:
        raise SimulatorError(
            f"its environments are in a {type(vector).__name__}, which gives none out; SyncVectorEnv does"
        )
    return envs[0]


def decode_config(config: Mapping[str, Any]) -> Any:
    """The LeRobot `EnvConfig` of its plain values; imports LeRobot, and its plugins."""
    import draccus
    from lerobot.envs.configs import EnvConfig

    from lerobot_roborecover.utils.plugins import register_plugins

    if config["type"] not in EnvConfig.get_known_choices():
        register_plugins()
    return draccus.decode(EnvConfig, dict(config))
