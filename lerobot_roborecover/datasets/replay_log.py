"""Replays scenarios in worker processes and logs what each replay gave, so that a stopped run goes on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.versions import installed
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.journal import AppendOnly, InUseError
from lerobot_roborecover.workers.jobs import JobPool


@dataclass(frozen=True)
class ReplayItem:
    """One replay."""

    scenario: Scenario
    key: str
    """Whatever decides what it gives, as a hash: an entry of the log with the same key stands for it."""
    turn: int = 0
    """Replays of different turns are in different jobs. Odd turns take the scenarios in reverse."""


def replay_logged(
    items: Sequence[ReplayItem],
    log: Path,
    pool: JobPool,
    work: Callable[..., list[dict[str, Any]]],
    arguments: Callable[[list[Scenario]], tuple],
    *,
    per_job: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """Does the replays that a log does not hold yet.

    Args:
        items: replays of scenarios of one platform.
        log: JSON lines, one a replay.
        pool: processes that replay.
        work: a function of a module that replays some scenarios of one task and returns an entry of JSON
            values for each. An entry with `error` is not logged: that replay is tried again by the next run.
        arguments: of `work`, for the scenarios of one job.
        per_job: most scenarios of a job.
        progress: called with the numbers of replays done and in all.

    Returns:
        One entry an item, in order.

    Raises:
        ScenarioError: the log is damaged, cannot be written, or another process has it open.
        SimulatorError: the simulator cannot be made, or a worker process died.
    """
    file, logged = _open_log(log)
    with file:
        found = {i: logged[item.key] for i, item in enumerate(items) if item.key in logged}
        progress(len(found), len(items))
        jobs = _jobs(items, [i for i in range(len(items)) if i not in found], per_job)
        for rows, entries in pool.run(work, jobs, lambda rows: arguments([items[i].scenario for i in rows])):
            for i, entry in zip(rows, entries, strict=True):
                found[i] = entry
                if "error" not in entry:
                    file.append(json.dumps({"key": items[i].key, **entry}).encode())
                progress(len(found), len(items))
    return [found[i] for i in range(len(items))]


def read_replays(log: Path) -> dict[str, dict[str, Any]]:
    """Entries of a log by key; none where there is no log.

    Raises:
        ScenarioError: the log is damaged, cannot be read, or another process has it open.
    """
    if not log.exists():
        return {}
    file, logged = _open_log(log)
    file.close()
    return logged


def deciding_versions(platform: str, options: Mapping[str, Any]) -> str:
    """Versions and surroundings that decide what a replay gives, as text for keys."""
    found = platform_named(platform)
    versions = {name: installed(name) for name in found.required_versions}
    return json.dumps([versions, found.environment_fingerprint(options)])


def _jobs(items: Sequence[ReplayItem], rows: Sequence[int], per_job: int) -> list[list[int]]:
    """Rows in groups of one task and turn each, because a simulator compiles each task once."""
    groups: dict[tuple[str, str, int], list[int]] = {}
    for i in rows:
        task = items[i].scenario.task
        groups.setdefault((task.suite, task.name, items[i].turn), []).append(i)
    ordered = [rows[::-1] if turn % 2 else rows for (_, _, turn), rows in groups.items()]
    return [group[i : i + per_job] for group in ordered for i in range(0, len(group), per_job)]


def _open_log(log: Path) -> tuple[AppendOnly, dict[str, dict[str, Any]]]:
    """The log, and finished replays by key; a last line that a crash cut short goes.

    Raises:
        ScenarioError: it is damaged, cannot be written, or another process has it open.
    """
    try:
        file = AppendOnly(log)
    except OSError as err:
        raise ScenarioError(f"{log} cannot be written: {err}. Name another working folder") from err
    except InUseError as err:
        raise ScenarioError(f"{err}; stop that one first, or name another working folder") from None
    found = {}
    for number, line in enumerate(file.lines(), 1):
        try:
            entry = json.loads(line)
            found[entry["key"]] = entry
        except (ValueError, KeyError, TypeError):
            file.close()
            raise ScenarioError(f"{log}, line {number} is damaged; delete the file to start again") from None
    file.cut()
    return file, found
