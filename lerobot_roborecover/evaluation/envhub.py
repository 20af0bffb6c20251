"""A scenario set as an environment of LeRobot's EnvHub: a repository whose `env.py` offers `make_env`.

LeRobot fetches that file and calls it (`HubEnvConfig(hub_path="org/name@commit")`). The one generated here
names the set, its revision and its split, and leaves the work to this package.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.errors import OptionError

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
    from lerobot_roborecover.evaluation.vector_env import ScenarioVectorEnv


@dataclass(frozen=True)
class HubScenarios:
    """What an EnvHub repository offers."""

    platform: str
    scenarios: str
    """Hub id, folder, or a shipped set's name."""
    revision: str | None = None
    """Commit, tag or branch of a set on the Hub."""
    split: str | None = None
    """Only this split; None takes all."""


def make_hub_env(
    offer: HubScenarios, n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[str, ScenarioVectorEnv]]:
    """What LeRobot's `make_env` returns for an EnvHub repository: `{group: {scenario id: vector env}}`.

    Args:
        offer: the repository's scenarios.
        n_envs: trials in a batch.
        use_async_envs: simulators in processes of their own.
        cfg: LeRobot's `HubEnvConfig`, or a subclass: its further fields are options of
            `--env.type=roborecover_*`, such as `start`, `select` or `obs_type`; its `task` selects by name.

    Raises:
        OptionError: a field is no option, or cannot be used.
        ScenarioError: the set cannot be loaded.
    """
    return _env_config(offer, cfg).create_envs(n_envs, use_async_envs)


def make_hub_processors(offer: HubScenarios, cfg: Any = None) -> tuple[Any, Any]:
    """LeRobot's env preprocessor and postprocessor of the platform: a `HubEnvConfig` has none.

    Args:
        offer: the repository's scenarios.
        cfg: as for `make_hub_env`.

    Raises:
        OptionError: a field is no option, or cannot be used.
    """
    return _env_config(offer, cfg).get_env_processors()


def _env_config(offer: HubScenarios, cfg: Any) -> RecoveryEnvConfig:
    """The recovery env config that a repository and its user's options make."""
    import draccus

    from lerobot_roborecover.evaluation.env_configs import env_type
    from lerobot_roborecover.platforms import platform_named

    kind = env_type(offer.platform)
    known = {field.name for field in dataclasses.fields(kind)}
    options = {k: v for k, v in dataclasses.asdict(offer).items() if k != "platform" and v is not None}
    options |= _options_of(cfg, known)
    return draccus.decode(kind, {**platform_named(offer.platform).env_defaults, **options})


def _options_of(cfg: Any, known: set[str]) -> dict[str, Any]:
    """Options that a hub configuration names beside LeRobot's own fields."""
    if cfg is None:
        return {}
    from lerobot.envs.configs import HubEnvConfig

    lerobots = {field.name for field in dataclasses.fields(HubEnvConfig)}
    given = {f.name: getattr(cfg, f.name) for f in dataclasses.fields(cfg) if f.name not in lerobots}
    unknown = sorted(set(given) - known)
    if unknown:
        raise OptionError(
            f"{type(cfg).__name__}.{unknown[0]}: no option of these scenarios. There are "
            f"{', '.join(sorted(known))}"
        )
    if cfg.task:
        terms = [given.get("select", ""), f"task={cfg.task}"]
        given["select"] = "; ".join(term for term in terms if term)
    return {name: value for name, value in given.items() if value is not None}
