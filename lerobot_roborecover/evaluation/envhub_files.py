"""Writes the files of an EnvHub repository: `env.py`, which runs, its requirements, and a card."""

from __future__ import annotations

import re
from pathlib import Path

from lerobot_roborecover._version import __version__
from lerobot_roborecover.datasets.card import render_card, render_text
from lerobot_roborecover.datasets.load import HUB_ID, ScenarioSet, builtin_names
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.envhub import HubScenarios
from lerobot_roborecover.platforms import Platform, platform_named
from lerobot_roborecover.platforms.registry import env_type_of
from lerobot_roborecover.platforms.versions import installed
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.outputs import check_page

_MADE_HERE = re.compile(rb"Made by `roborecover (dataset )?envhub`")
"""In `env.py`; files of versions whose command was `envhub` are ours, too."""


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
        install=platform.install_command,
        env_type=env_type_of(platform.env_name or platform.name),
        **values,
    )
    texts = {
        "env.py": render_text("env.py.j2", **values),
        "README.md": card,
        "requirements.txt": _requirements(platform),
    }
    check_page(out, list(texts), lambda page: _MADE_HERE.search(page.read_bytes()) is not None)
    for name, text in texts.items():
        atomic_write(out / name, text)
    return [out / name for name in texts]


def _requirements(platform: Platform) -> str:
    """This package, and the platform's own where another distribution brings it, at the versions in use."""
    extra = f"[{platform.extra}]" if platform.extra else ""
    ours = Platform.distribution
    if platform.distribution == ours:
        return f"{ours}{extra}=={__version__}\n"
    version = installed(platform.distribution)
    return f"{ours}=={__version__}\n{platform.distribution}{extra}" + (f"=={version}\n" if version else "\n")
