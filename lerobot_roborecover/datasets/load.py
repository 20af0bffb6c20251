"""Finds a scenario set by name, folder or Hub id, reads it, and hands it out as an immutable sequence.

The selection language: an expression is terms separated by ";", all of which must hold. A term is
`key=value`, or `key=value|value` for any of several; values take the shell wildcards `*`, `?` and `[...]` and
are compared with case. Keys: id, suite, task, stage, type, cell, source, policy, split. Example:

    suite=libero_goal|libero_10; source=natural; cell=Approach-*
"""

from __future__ import annotations

import fnmatch
import importlib.resources
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

from lerobot_roborecover.datasets.files import finish_update
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.schema import FOLDER, MANIFEST_FILE
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.text import nearest

__all__ = ["ScenarioSet", "builtin_names", "load_scenarios", "validate_for"]

logger = logging.getLogger(__name__)

HUB_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}/[A-Za-z0-9][A-Za-z0-9._-]{0,95}")
"""An id on the Hub: org/name."""

_KEYS: dict[str, Callable[[Scenario], str]] = {
    "id": lambda s: s.id,
    "suite": lambda s: s.task.suite,
    "task": lambda s: s.task.name,
    "stage": lambda s: s.stage.value,
    "type": lambda s: s.deviation.value,
    "cell": lambda s: s.cell,
    "source": lambda s: s.source.value,
    "policy": lambda s: s.source_policy,
    "split": lambda s: s.split,
}
_SHOWN_VALUES = 20


@dataclass(frozen=True, eq=False)
class ScenarioSet(Sequence[Scenario]):
    """Scenarios of one dataset, in the dataset's order, with where they came from."""

    scenarios: tuple[Scenario, ...]
    source: str
    """What was asked for: a folder, a built-in name or a Hub dataset id."""
    revision: str | None
    """The Hub commit that was read; None for a folder or a built-in set."""
    manifest: Mapping[str, Any]
    """`meta/roborecover/manifest.json` of the whole dataset, before any selection."""
    root: Path | None = None
    """Folder that was read; None for scenarios that were never in one."""

    def __post_init__(self):
        object.__setattr__(self, "scenarios", tuple(self.scenarios))

    @cached_property
    def _by_id(self) -> dict[str, Scenario]:
        return {s.id: s for s in self.scenarios}

    @property
    def platform(self) -> str:
        """The one platform of all scenarios."""
        return self.manifest["platform"]

    @property
    def ids(self) -> tuple[str, ...]:
        """Scenario ids, in order."""
        return tuple(s.id for s in self.scenarios)

    def __len__(self) -> int:
        return len(self.scenarios)

    def __iter__(self) -> Iterator[Scenario]:
        return iter(self.scenarios)

    @overload
    def __getitem__(self, key: int | str) -> Scenario: ...
    @overload
    def __getitem__(self, key: slice) -> ScenarioSet: ...
    def __getitem__(self, key):
        """A scenario by position or by id, or a smaller set by slice.

        Raises:
            KeyError: no scenario has that id.
        """
        if isinstance(key, str):
            return self._by_id[key]
        if isinstance(key, slice):
            return replace(self, scenarios=self.scenarios[key])
        return self.scenarios[key]

    def __contains__(self, item: object) -> bool:
        """Whether the set holds a scenario of this id, or this very scenario."""
        if isinstance(item, Scenario):
            return self._by_id.get(item.id) is item
        return item in self._by_id

    def select(self, expression: str) -> ScenarioSet:
        """The scenarios that an expression selects; see the top of this module."""
        return replace(self, scenarios=tuple(select_scenarios(self.scenarios, expression)))

    def shard(self, k: int, n: int) -> ScenarioSet:
        """Part k of n, counted from 0, for runs on several machines.

        The parts of one n share no scenario and together are the whole set; their sizes differ by at most
        one, so that parts are empty where n exceeds the number of scenarios. Scenarios of one task stay
        together as far as that allows, because a simulator compiles each task once.

        Raises:
            ScenarioError: k is not in 0 to n - 1.
        """
        if not 0 <= k < n:
            raise ScenarioError(f"shard {k}/{n}: the part must be from 0 to {n - 1}, e.g. 0/4 to 3/4")
        tasks = [(s.task.suite, s.task.name) for s in self.scenarios]
        order = sorted(range(len(self)), key=tasks.__getitem__)
        part = sorted(order[k * len(self) // n : (k + 1) * len(self) // n])
        return replace(self, scenarios=tuple(self.scenarios[i] for i in part))


def load_scenarios(
    source: str | os.PathLike[str],
    *,
    revision: str | None = None,
    split: str | None = None,
    select: str = "",
) -> ScenarioSet:
    """Loads a scenario set.

    Args:
        source: a folder that holds `meta/roborecover/`, a built-in name (`builtin_names`), or a Hub dataset
            id "org/name", of which only `meta/roborecover/` is downloaded.
        revision: tag, branch or commit on the Hub; a commit or a tag makes results repeatable.
        split: keep this split only.
        select: keep what the expression selects, e.g. `"suite=libero_goal|libero_10; source=natural"`.

    Raises:
        ScenarioError: nothing is found, it cannot be read, it is invalid, or nothing is left of it.
    """
    text = os.fspath(source)
    root, commit = _locate(source, revision or None)
    scenarios, manifest = read_with_manifest(root)
    found = ScenarioSet(tuple(scenarios), text, commit, manifest, root)
    if split:
        splits = manifest["counts"]["split"]
        if split not in splits:
            raise ScenarioError(f"{text} has no split {split!r}; there are {splits}")
        found = replace(found, scenarios=tuple(s for s in found if s.split == split))
    return found.select(select)


def builtin_names(*, shipped: bool = False) -> list[str]:
    """Names of the scenario sets that are found by name.

    Args:
        shipped: only those that come with the package, not those of the studies in a clone.
    """
    return sorted(_builtin(shipped=shipped))


def _builtin(*, shipped: bool = False) -> dict[str, Path]:
    """Folder of each set by its name: a set of the package, or the `scenarios` of a study of the clone."""
    package = Path(str(importlib.resources.files("lerobot_roborecover")))
    found = {path.name: path for path in package.glob("data/*")}
    if not shipped:
        studies = {path.name: path / "scenarios" for path in package.parent.glob("policies/study/*")}
        found = studies | found
    return {name: path for name, path in found.items() if (path / FOLDER / MANIFEST_FILE).is_file()}


def _locate(source: str | os.PathLike[str], revision: str | None) -> tuple[Path, str | None]:
    """The folder of a source, downloaded where needed, and the Hub commit it is of."""
    text = os.fspath(source)
    found = _builtin()
    builtin = sorted(found)
    if text not in builtin:
        finish_update(Path(text).expanduser())
    if isinstance(source, str) and text in builtin:
        if Path(text).is_dir():
            logger.warning("scenarios %r: taking the built-in set; for the folder say ./%s", text, text)
        root = found[text]
    elif Path(text).expanduser().is_dir():
        root = Path(text).expanduser()
    elif isinstance(source, str) and HUB_ID.fullmatch(text):
        from lerobot_roborecover.datasets.hub import pull

        return pull(text, revision)
    else:
        near = nearest(text, builtin)
        hint = f"the nearest is {near}; " if near else ""
        raise ScenarioError(
            f"scenarios {text[:200]!r} is neither a folder, nor a built-in set ({hint}there are {builtin}), "
            "nor a Hub dataset id like org/name. Check the spelling, or the path from the current directory"
        )
    if revision:
        raise ScenarioError(
            f"scenarios {text[:200]!r} is a {'built-in set' if text in builtin else 'folder'}, which has no "
            f"revision {revision!r}; leave the revision out, or name a Hub dataset"
        )
    return root, None


def _parse_selection(expression: str) -> list[tuple[str, tuple[str, ...]]]:
    """The terms of an expression as (key, patterns); none for a blank expression.

    Raises:
        ScenarioError: a term is empty or has no `key=value` form, or a key is unknown.
    """
    if not expression.strip():
        return []
    terms = []
    for number, term in enumerate(expression.split(";"), 1):
        key, equals, values = (part.strip() for part in term.partition("="))
        patterns = tuple(value.strip() for value in values.split("|"))
        if not equals or not key or not all(patterns):
            raise ScenarioError(
                f"selection {expression!r}: term {number} is {term.strip()!r}; write key=value or "
                f"key=value|value, terms separated by ';'. Keys: {', '.join(_KEYS)}"
            )
        if key not in _KEYS:
            raise ScenarioError(f"selection {expression!r}: unknown key {key!r}. Keys: {', '.join(_KEYS)}")
        terms.append((key, patterns))
    return terms


def select_scenarios(scenarios: Sequence[Scenario], expression: str) -> list[Scenario]:
    """The scenarios for which every term holds, in their order.

    Raises:
        ScenarioError: the expression is malformed, one of its values matches no scenario at all (a
            misspelling would otherwise shrink a selection unseen), or nothing is left; the message lists what
            there is.
    """
    terms = _parse_selection(expression)
    for key, patterns in terms:
        values = {_KEYS[key](s) for s in scenarios}
        for pattern in patterns:
            if not any(fnmatch.fnmatchcase(value, pattern) for value in values):
                raise ScenarioError(
                    f"selection {expression!r}: {key}={pattern} matches none of {len(scenarios)} scenarios. "
                    f"There are: {_tally(scenarios, key)}"
                )
    chosen = [
        s
        for s in scenarios
        if all(any(fnmatch.fnmatchcase(_KEYS[k](s), p) for p in patterns) for k, patterns in terms)
    ]
    if not chosen:
        listed = "; ".join(f"{key}: {_tally(scenarios, key)}" for key in dict.fromkeys(k for k, _ in terms))
        raise ScenarioError(
            f"selection {expression!r} is empty: no scenario fulfils all its terms at once. "
            f"There are {listed}"
        )
    return chosen


def _tally(scenarios: Iterable[Scenario], key: str) -> str:
    """The values of a key with their numbers, the most frequent first."""
    found = Counter(_KEYS[key](s) for s in scenarios)
    shown = ", ".join(f"{value} ({count})" for value, count in found.most_common(_SHOWN_VALUES))
    more = len(found) - _SHOWN_VALUES
    return shown + (f", and {more} more" if more > 0 else "")


def validate_for(scenarios: Sequence[Scenario], platform: str) -> None:
    """Checks that a platform can run every scenario, before any simulator starts.

    Args:
        scenarios: what is to be run.
        platform: that of the env type which is to run it, e.g. `libero` for `roborecover_libero`.

    Raises:
        ScenarioError: there are none, they are of another platform, or a suite or task is unknown to the
            platform.
    """
    from lerobot_roborecover.platforms import platform_named

    own = platform_named(platform)
    if not scenarios:
        raise ScenarioError("there are no scenarios to run; check the selection")
    for scenario in scenarios:
        if scenario.platform != platform:
            raise ScenarioError(
                f"scenario {scenario.id} is of platform {scenario.platform!r}, but the env type is "
                f"roborecover_{platform}; use --env.type=roborecover_{scenario.platform}"
            )
    checked = set()
    for scenario in scenarios:
        if scenario.task not in checked:
            try:
                own.check_task(scenario.task)
            except ScenarioError as err:
                raise ScenarioError(f"scenario {scenario.id}: {err}") from None
            checked.add(scenario.task)
