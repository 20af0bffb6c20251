"""`roborecover dataset pull`, `repair` and `envhub`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.cli.arguments import OwnCommand
from lerobot_roborecover.utils.options import option


@dataclass(frozen=True, kw_only=True)
class PullOptions:
    """What to pull, and where to."""

    repo_id: str = option(positional=True, metavar="ORG/NAME")
    """Dataset on the Hub."""
    revision: str | None = None
    """Tag, branch or commit; a commit or a version tag makes results repeatable."""
    out: Path
    """New folder."""
    evaluation_only: bool = False
    """meta/roborecover/ alone, without episodes."""


def _pull(options: PullOptions) -> int:
    from lerobot_roborecover.datasets.pull import pull_dataset

    done = pull_dataset(
        options.repo_id, options.out, revision=options.revision, evaluation_only=options.evaluation_only
    )
    print(f"{done.root}: {done.files} files, {done.bytes / 1e6:.1f} MB\nrevision {done.commit}")
    return 0


PULL = OwnCommand(
    "Pull a dataset from the Hugging Face Hub into a new folder: all of it, checked, or nothing.",
    PullOptions,
    _pull,
)


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """What to repair."""

    dataset: Path = option(positional=True)
    """Folder that a tool has made."""
    sources: tuple[str, ...] = option(name="from", nargs="+", metavar="SOURCE")
    """Datasets it was made from."""
    dry_run: bool = False
    """Say what would be done, and change nothing."""


def _repair(options: RepairOptions) -> int:
    """Repairs, and says what it did."""
    from lerobot_roborecover.curation.repair import repair_dataset

    print("\n".join(repair_dataset(options.dataset, options.sources, dry_run=options.dry_run).lines))
    return 0


REPAIR = OwnCommand(
    "Rebuild a dataset's meta/roborecover after LeRobot's tools (merge, delete, split) have worked on it.",
    RepairOptions,
    _repair,
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


def _envhub(options: EnvHubOptions) -> int:
    """Writes the files and says how to upload them."""
    from lerobot_roborecover.datasets import load_scenarios
    from lerobot_roborecover.evaluation.envhub import write_envhub

    found = load_scenarios(options.scenarios, revision=options.revision, split=options.split)
    for path in write_envhub(found, options.out, options.repo_id, options.split):
        print(f"wrote     {path}")
    print(f"offer it  hf upload {options.repo_id} {options.out}")
    print(f'use it    make_env(HubEnvConfig(hub_path="{options.repo_id}"), trust_remote_code=True)')
    return 0


ENVHUB = OwnCommand(
    "Write an EnvHub repository (env.py, requirements, a card) that offers a scenario set as an environment.",
    EnvHubOptions,
    _envhub,
)
