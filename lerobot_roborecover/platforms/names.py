"""Finds tasks by name and pattern, and suggests names for a misspelt one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from lerobot_roborecover.scenario import ScenarioError, Task


def nearest(name: str, names: Iterable[str]) -> str:
    """The end of a message about a name that there is not: those that it may have meant."""
    names = list(names)
    if not names:
        return ""
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    return f"; nearest: {', '.join(close)}" if close else f"; there are {', '.join(sorted(names))}"


def choose_tasks(tasks: Sequence[Task], patterns: Iterable[str]) -> list[Task]:
    """Tasks that match any of the patterns, in the order of the catalogue.

    Args:
        tasks: of the platform.
        patterns: a suite, a task's name, `suite/name`, each with `*`, `?` and `[...]`.

    Raises:
        ScenarioError: a pattern matches none; names the nearest.
    """
    chosen: set[int] = set()
    for pattern in patterns:
        hits = {
            k
            for k, t in enumerate(tasks)
            if any(fnmatchcase(name, pattern) for name in (t.suite, t.name, f"{t.suite}/{t.name}"))
        }
        if not hits:
            names = (
                {t.suite for t in tasks} | {t.name for t in tasks} | {f"{t.suite}/{t.name}" for t in tasks}
            )
            platform = tasks[0].platform if tasks else "the platform"
            raise ScenarioError(f"--task {pattern!r:.120}: no task of {platform}{nearest(pattern, names)}")
        chosen |= hits
    if not chosen:
        raise ScenarioError("no task: give --task SUITE, --task NAME or --task 'SUITE/PATTERN*'")
    return [t for k, t in enumerate(tasks) if k in chosen]
