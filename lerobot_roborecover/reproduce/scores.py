"""What is published about a checkpoint: package data, read and never guessed."""

from __future__ import annotations

import importlib.resources
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.analysis.published import policies
from lerobot_roborecover.analysis.stats.agreement import mixed_rate
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.scenario import Scenario

PAPER_SET = "the paper's 200 test scenarios"


@dataclass(frozen=True)
class PublishedScore:
    """One published initial-state rate."""

    rate: Estimate
    on: str
    """The tasks it was measured on."""
    source: str


@dataclass(frozen=True)
class PublishedCheckpoint:
    """A checkpoint and how it is evaluated."""

    name: str
    config: Path
    """A file of `policies/eval`, or one like it."""
    arguments: tuple[str, ...] = ()
    """For `roborecover eval`, beside the file."""
    checkpoint: str = ""
    weights: str = ""
    """Whether the paper ran these weights."""
    paper: tuple[str, str] | None = None
    """Platform and policy of the paper's row."""
    makers: Mapping[str, Any] = field(default_factory=dict)

    @property
    def initial(self) -> PublishedScore | None:
        """The paper's initial-state rate of this policy."""
        row = self._row()
        return None if row is None else PublishedScore(row.initial, PAPER_SET, "the paper, complete results")

    @property
    def recovery(self) -> Estimate | None:
        """The paper's recovery success rate of this policy."""
        row = self._row()
        return None if row is None else row.rsr

    def of_makers(self, scenarios: Sequence[Scenario]) -> PublishedScore | None:
        """Its makers' rate, their suites weighed as in a scenario set; None where a suite has none."""
        known = self.makers.get("suites", {})
        count = Counter(s.task.suite for s in scenarios)
        if not count or not set(count) <= set(known):
            return None
        shares = [n / count.total() for n in count.values()]
        rate = mixed_rate([known[s] / 100 for s in count], shares, self.makers.get("episodes"))
        return PublishedScore(rate, "the makers' suites, weighed as this set's", self.makers["source"])

    def _row(self) -> Any:
        found = [p for p in policies() if (p.platform, p.policy) == self.paper]
        return found[0] if found else None


@cache
def _entries() -> dict[str, dict[str, Any]]:
    folder = importlib.resources.files("lerobot_roborecover").joinpath("data", "published")
    return yaml.safe_load(folder.joinpath("checkpoints.yaml").read_text("utf-8"))


def known_names() -> list[str]:
    """Names of the checkpoints about which something is known."""
    return sorted(_entries())


def find_checkpoint(name: str, folders: Sequence[Path] = ()) -> PublishedCheckpoint:
    """A checkpoint by its name, or by a configuration of one's own.

    Args:
        name: of `known_names`, or a YAML file as `--config_path` takes it, about which nothing is published.
        folders: that may hold the files; by default the clone's `policies/eval`, then that of the working
            directory.

    Raises:
        OptionError: there is no such name or file, or the file lies in a clone that is not here.
    """
    if name.endswith((".yaml", ".yml", ".json")):
        path = Path(name)
        if not path.is_file():
            raise OptionError(f"{name}: there is no such file")
        return PublishedCheckpoint(path.stem, path)
    entry = _entries().get(name)
    if entry is None:
        raise OptionError(
            f"{name!r} is no checkpoint of policies/eval; there are {', '.join(known_names())}. For one of "
            "your own give a configuration file, FILE.yaml, and --published RATE"
        )
    file = f"{entry.get('config', name)}.yaml"
    searched = folders or (Path(__file__).parents[2] / "policies" / "eval", Path("policies") / "eval")
    for folder in searched:
        if (folder / file).is_file():
            return PublishedCheckpoint(
                name, folder / file, tuple(entry.get("arguments", ())), entry["checkpoint"],
                entry["weights"], tuple(entry["paper"]), entry.get("makers", {}),
            )  # fmt: skip
    raise OptionError(
        f"{file} is not in {' or '.join(map(str, searched))}: the configurations come with a clone, not with "
        "the installed package. Run this in a clone, or give the file itself"
    )
