"""What the scenario sets that trial rows name say of them, where a set is on this machine: first states of
rows that do not say theirs (logs before schema 3), and which of the policies have screened it.

First states are looked up in the sets that come with the package, too. A scenario is only taken for another's
where its content hash is the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from lerobot_roborecover.datasets.load import HUB_ID, builtin_names, load_scenarios
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import ReadLog
from lerobot_roborecover.scenario import Scenario, ScenarioError, Start
from lerobot_roborecover.utils.text import pluralize

type _Found = dict[str, str]
"""First states by the content hash of their scenarios."""


def with_first_states(logs: Sequence[ReadLog]) -> tuple[list[ReadLog], list[str]]:
    """Returns the logs with the first state in every row where it can be found, and remarks on the rest.

    Nothing is looked up where no initial-state trial lacks its first state.

    Args:
        logs: as they were read.
    """
    rows = [row for log in logs for row in log.rows]
    lacking = {row.scenario_sha256 for row in rows if row.start == Start.INITIAL and not row.first_state}
    if not lacking:
        return list(logs), []
    found = {row.scenario_sha256: row.first_state for row in rows if row.first_state}
    unnamed = [row for row in rows if not row.first_state]
    for dataset, revision in dict.fromkeys((row.dataset, row.dataset_revision) for row in unnamed):
        if lacking - found.keys():
            found |= _of_set(dataset, revision)
    for name in builtin_names():
        if lacking - found.keys():
            found |= _of_set(name, None)
    filled = [replace(log, rows=tuple(_filled(row, found) for row in log.rows)) for log in logs]
    unknown = len(lacking - found.keys())
    if not unknown:
        return filled, []
    return filled, [
        f"the logs do not say which first state {pluralize(unknown, 'scenario')} branch off from, and their "
        "set is not on this machine: each counts as a first state of its own, so that intervals of initial-"
        "state rates, and retention, may be too narrow. Run the initial-state trials again, or put the set "
        "where the rows name it"
    ]


def screening_remark(logs: Iterable[ReadLog]) -> list[str]:
    """A remark where policies of the logs have the name of one that screened their scenarios.

    Args:
        logs: as they were read.
    """
    found: dict[str, str] = {}
    for log in logs:
        sets = dict.fromkeys((row.dataset, row.dataset_revision) for row in log.rows)
        screeners = {policy.partition("@")[0]: policy for one in sets for policy in _screeners(*one)}
        for policy in log.policies:
            if (name := policy.partition("@")[0]) in screeners:
                found[name] = screeners[name]
    if not found:
        return []
    return [
        f"{', '.join(sorted(found))}: a policy of this name ({', '.join(sorted(found.values()))}) screened "
        "the scenarios, which are those that some, but not all, of the screening policies recover from. Its "
        "rate, and its rank among policies that did not screen them, hold for this set only"
    ]


@lru_cache(maxsize=32)
def _screeners(dataset: str, revision: str | None) -> frozenset[str]:
    """Returns the policies that screened a set that is on this machine."""
    try:
        notes = [s.provenance.get("screening") for s in _scenarios(dataset, revision)]
    except (ScenarioError, OSError):
        return frozenset()
    counts = [
        count
        for note in notes
        if isinstance(note, Mapping) and isinstance(note.get("policies"), Mapping)
        for count in note["policies"].values()
    ]
    return frozenset(str(c["policy"]) for c in counts if isinstance(c, Mapping) and c.get("policy"))


def _filled(row: TrialRow, found: _Found) -> TrialRow:
    state = found.get(row.scenario_sha256, "")
    return row if row.first_state or not state else replace(row, first_state=state)


@lru_cache(maxsize=32)
def _of_set(dataset: str, revision: str | None) -> _Found:
    """Returns the first states of a set that is on this machine; none of another."""
    try:
        return _states(_scenarios(dataset, revision))
    except (ScenarioError, OSError):
        return {}


def _scenarios(dataset: str, revision: str | None) -> Iterable[Scenario]:
    if dataset in builtin_names() or Path(dataset).is_dir():
        return load_scenarios(dataset)
    if not HUB_ID.fullmatch(dataset):
        return []
    from lerobot_roborecover.datasets.hub import cached_folder  # an HTTP client is slow to import

    folder = cached_folder(dataset, revision)
    return [] if folder is None else read_with_manifest(folder)[0]


def _states(scenarios: Iterable[Scenario]) -> _Found:
    return {s.sha256(): s.first_state_sha256() for s in scenarios}
