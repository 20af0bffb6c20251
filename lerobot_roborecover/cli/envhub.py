"""`roborecover dataset envhub`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.utils.options import option

HELP = (
    "Write an EnvHub repository (env.py, requirements, a card) that offers a scenario set as an environment."
)


@dataclass(frozen=True, kw_only=True)
class EnvHubOptions:
    """Which scenarios to offer, and under which name."""

    scenarios: str = option(positional=True)
    """Scenario set: Hub id (org/name), or the name of a shipped one."""
    revision: str | None = None
    """Commit, tag or branch of the set; the commit that is read is what env.py names."""
    split: str | None = None
    """This split only, e.g. test."""
    repo_id: str = option(metavar="ORG/NAME")
    """What the environment will be called on the Hub."""
    out: Path
    """Folder of the repository's files."""


OPTIONS = EnvHubOptions


def run(options: EnvHubOptions) -> int:
    """Writes the files and says how to upload them."""
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.evaluation.envhub import write_envhub

    found = load_scenarios(options.scenarios, revision=options.revision, split=options.split)
    for path in write_envhub(found, options.out, options.repo_id, options.split):
        print(f"wrote     {path}")
    print(f"offer it  hf upload {options.repo_id} {options.out}")
    print(f'use it    make_env(HubEnvConfig(hub_path="{options.repo_id}"), trust_remote_code=True)')
    return 0
