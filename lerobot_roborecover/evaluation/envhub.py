"""A scenario set as an environment of LeRobot's EnvHub: a repository whose `env.py` offers `make_env`.

LeRobot fetches that file and calls it (`HubEnvConfig(hub_path="org/name@commit")`). The one generated here
names the set, its revision and its split, and leaves the work to this package. `write_envhub` writes the
repository's files: `env.py`, which runs, its requirements, and a card.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.errors import OptionError

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
    from lerobot_roborecover.evaluation.vector_env import ScenarioVectorEnv
import re
import shlex
from pathlib import Path

from lerobot_roborecover._version import __version__
from lerobot_roborecover.datasets.card import render_card, render_text
from lerobot_roborecover.datasets.load import HUB_ID, ScenarioSet, builtin_names
from lerobot_roborecover.platforms import Platform, platform_named
from lerobot_roborecover.platforms.registry import env_type_of
from lerobot_roborecover.platforms.versions import installed
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import check_page

_MADE_HERE = re.compile(rb"Made by `roborecover (dataset )?envhub`")
"""In `env.py`; files of versions whose command was `envhub` are ours, too."""


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


def write_envhub(scenarios: ScenarioSet, out: Path, repo_id: str, split: str | None = None) -> list[Path]:
    """Writes the repository's folder; what is in it of other names stays.

    Args:
        scenarios: as loaded; a set of the Hub is named with the commit that was read.
        out: the folder; made if need be.
        repo_id: "org/name" that the environment will have on the Hub.
        split: that the scenarios were loaded with.

    Raises:
        OptionError: the id is invalid, or the set is a local folder, which other users do not have.
        OutputExistsError: `out` holds an `env.py` or a card that this command did not write.
    """
    if not HUB_ID.fullmatch(repo_id):
        raise OptionError(f"--repo-id {repo_id!r:.120}: write it like org/name")
    if scenarios.revision is None and scenarios.source not in builtin_names(shipped=True):
        raise OptionError(
            f"scenarios {scenarios.source!r:.200}: a folder, which others do not have. Publish it "
            "(roborecover dataset publish), and name it as org/name"
        )
    platform = platform_named(scenarios.platform)
    requirements = _requirements(platform)
    offer = HubScenarios(platform.name, scenarios.source, scenarios.revision, split)
    values = {
        "platform": offer.platform,
        "scenarios": offer.scenarios,
        "revision": offer.revision,
        "split": offer.split,
        "total": len(scenarios),
    }
    card = render_card(
        "envhub.md.j2",
        metadata={"tags": ["LeRobot", "RoboRecover", "robotics", "envhub"], "library_name": "lerobot"},
        title=repo_id.split("/")[-1],
        repo_id=repo_id,
        on_hub=bool(HUB_ID.fullmatch(offer.scenarios)),
        install=shlex.join(["pip", "install", *requirements]),
        env_type=env_type_of(platform.env_name or platform.name),
        **values,
    )
    texts = {
        "env.py": render_text("env.py.j2", **values),
        "README.md": card,
        "requirements.txt": "".join(f"{line}\n" for line in requirements),
    }
    check_page(out, list(texts), lambda page: _MADE_HERE.search(page.read_bytes()) is not None)
    for name, text in texts.items():
        atomic_write(out / name, text)
    return [out / name for name in texts]


def _requirements(platform: Platform) -> list[str]:
    """This package, and the platform's own where another distribution brings it, at the versions in use."""
    extra = f"[{platform.extra}]" if platform.extra else ""
    ours = Platform.distribution
    if platform.distribution == ours:
        return [f"{ours}{extra}=={__version__}"]
    version = installed(platform.distribution)
    return [f"{ours}=={__version__}", f"{platform.distribution}{extra}" + (f"=={version}" if version else "")]
