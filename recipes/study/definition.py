"""What a study evaluates: `study.json` in a folder that holds scenarios, policies and stored outcomes.

study.json       this file
scenarios/       a scenario dataset, unless study.json names one that comes with the package
policies/NAME/   checkpoints, unless study.json names a folder of the checkout that has them
correction/      a checkpoint, optional
monitor/         a checkpoint, optional
outcomes.csv     what came of every trial, to compare with; optional
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

DEFINITION_FILE = "study.json"
OUTCOMES_FILE = "outcomes.csv"
SCHEMA_VERSION = 1
DEFAULT = "metaworld"
"""The study that is meant where none is named."""
MAX_TRIALS = 1000

IN_CHECKOUT = Path("policies/study")
"""Folder of the studies, from the top of a clone."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True)
class StudyDefinition:
    """A study's parts, as `study.json` says."""

    root: Path
    platform: str
    policies: Mapping[str, int]
    """Trials of each scenario by policy name; one suffices where policy and simulator are deterministic."""
    base: str
    """The policy that interventions are built around."""
    env: Mapping[str, str] = field(default_factory=dict)
    """Options of the recovery env type."""
    split: str = "test"
    interventions: tuple[str, ...] = ()
    """Modes of `roborecover_intervention`."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables that decide how policies round."""
    dataset: str = ""
    """Name of the scenario set, where it comes with the package."""
    policies_folder: str = ""
    """Of the policies, from the top of a checkout, where they are not the study's own."""
    learned_folder: str = ""
    """Of `correction/` and `monitor/`, from the top of a checkout, where they are another study's."""

    @property
    def scenarios(self) -> str:
        """The scenario dataset: a folder, or a name."""
        return self.dataset or str(self.root / "scenarios")

    def policy(self, name: str) -> Path:
        """A policy's checkpoint."""
        return (Path(self.policies_folder) if self.policies_folder else self.root / "policies") / name

    @property
    def correction(self) -> Path:
        """The correction policy's checkpoint."""
        return self._learned / "correction"

    @property
    def monitor(self) -> Path:
        """The monitor's checkpoint."""
        return self._learned / "monitor"

    @property
    def _learned(self) -> Path:
        return Path(self.learned_folder) if self.learned_folder else self.root

    @property
    def outcomes(self) -> Path:
        """Stored outcomes."""
        return self.root / OUTCOMES_FILE


def shipped_study(name: str = DEFAULT) -> Path:
    """Returns the folder of a study of the clone that this is run in.

    Raises:
        ScenarioError: there is none.
    """
    folders = {
        path.parent.name.removesuffix("_study"): path.parent
        for path in IN_CHECKOUT.glob(f"*/{DEFINITION_FILE}")
    }
    if name in folders:
        return folders[name]
    if folders:
        raise ScenarioError(
            f"no study {name!r:.80} in {IN_CHECKOUT}; there are {', '.join(sorted(folders))}. Take one of "
            "these, or make one with --make"
        )
    raise ScenarioError(f"no study in {IN_CHECKOUT}: run this in the top folder of a clone of the repository")


def read_definition(root: Path) -> StudyDefinition:
    """Reads `study.json` and checks that what it names is there.

    Raises:
        ScenarioError: names the file, the field and the remedy.
    """
    path = root / DEFINITION_FILE
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError:
        raise ScenarioError(
            f"{root} is not a study: it has no {DEFINITION_FILE}. `python -m recipes.study --make` makes one"
        ) from None
    except (OSError, ValueError, RecursionError) as err:
        raise ScenarioError(f"{path} cannot be read as JSON ({err!s:.200})") from None
    try:
        version = found.pop("schema_version")
        if version != SCHEMA_VERSION:
            raise ScenarioError(
                f"{path}, field schema_version: {version!r:.80}; this version reads {SCHEMA_VERSION}"
            )
        found["interventions"] = tuple(found.get("interventions", ()))
        study = StudyDefinition(root=root, **found)
    except (KeyError, TypeError, AttributeError) as err:
        raise ScenarioError(f"{path} is not a study's definition ({err!s:.200})") from None
    _check(path, study)
    return study


def write_definition(study: StudyDefinition) -> Path:
    """Writes `study.json` into the study's folder."""
    path = study.root / DEFINITION_FILE
    found = {
        "schema_version": SCHEMA_VERSION,
        "platform": study.platform,
        "policies": dict(study.policies),
        "base": study.base,
        "env": dict(study.env),
        "split": study.split,
        "interventions": list(study.interventions),
        "environment": dict(study.environment),
        **({"dataset": study.dataset} if study.dataset else {}),
        **({"policies_folder": study.policies_folder} if study.policies_folder else {}),
        **({"learned_folder": study.learned_folder} if study.learned_folder else {}),
    }
    atomic_write(path, json.dumps(found, indent=2) + "\n")
    return path


def _check(path: Path, study: StudyDefinition) -> None:
    from lerobot_roborecover.policies.interventions.options import MODES

    def wrong(name: str, value: object, wanted: str) -> ScenarioError:
        return ScenarioError(f"{path}, field {name}: {value!r:.200}; it must be {wanted}")

    for name in ("dataset", "policies_folder", "learned_folder"):
        if not isinstance(getattr(study, name), str):
            raise wrong(name, getattr(study, name), "a text")
    if not isinstance(study.policies, dict) or not study.policies:
        raise wrong("policies", study.policies, "an object of policy names and trial counts")
    for name, trials in study.policies.items():
        if not _NAME.fullmatch(name):
            raise wrong("policies", name, "a name of letters, digits, '-' and '_'")
        if type(trials) is not int or not 1 <= trials <= MAX_TRIALS:
            raise wrong(f"policies.{name}", trials, f"a count from 1 to {MAX_TRIALS}")
        if not study.policy(name).is_dir():
            where = ": run this in the top folder of a checkout" if study.policies_folder else ""
            raise ScenarioError(
                f"{path} names policy {name}, but {study.policy(name)} is not a folder{where}"
            )
    if study.base not in study.policies:
        raise wrong("base", study.base, f"one of {sorted(study.policies)}")
    for mode in study.interventions:
        if mode not in MODES or mode == "human":
            raise wrong("interventions", mode, f"among {[m for m in MODES if m != 'human']}")
        for part, folder in (("correction", study.correction), ("monitor", study.monitor)):
            needed = mode.endswith("correction") if part == "correction" else mode.startswith("monitor")
            if needed and not folder.is_dir():
                raise ScenarioError(f"{path}: mode {mode} needs a {part}, but {folder} is not a folder")
    for name in ("env", "environment"):
        texts = getattr(study, name)
        if not isinstance(texts, dict) or not all(isinstance(v, str) for v in texts.values()):
            raise wrong(name, texts, "an object of texts")
    if not study.dataset and not Path(study.scenarios).is_dir():
        raise ScenarioError(f"{path}: {study.scenarios} is not a folder; it must hold the scenario dataset")
