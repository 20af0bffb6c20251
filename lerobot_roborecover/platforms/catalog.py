"""A platform's tasks, how they are found by name, pattern or instruction, and suggestions for a misspelt
name."""

from __future__ import annotations

import difflib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, ClassVar

from lerobot_roborecover.scenario import ScenarioError, Task


class TaskCatalog:
    """The tasks of one platform: override `tasks`, and the rest follows."""

    name: ClassVar[str]
    """The platform's."""

    def tasks(self, options: Mapping[str, Any] | None = None) -> Sequence[Task]:
        """Every task, in the catalogue's order.

        Args:
            options: of the simulator, where the catalogue depends on them.

        Raises:
            SimulatorError: what the catalogue is read from is not installed.
        """
        raise NotImplementedError

    def task(self, name: str, instruction: str = "", suite: str = "") -> Task:
        """A task by its name.

        Args:
            name: the platform's own task name.
            instruction: as recorded; by default the platform's own.
            suite: needed only where several have a task of this name.

        Raises:
            ScenarioError: there is no such task, or there are several.
        """
        found = [t for t in self.tasks() if t.name == name and suite in ("", t.suite)]
        if not found:
            there = {t.name for t in self.tasks() if suite in ("", t.suite)}
            of = f" in suite {suite!r:.80}" if suite else ""
            raise ScenarioError(f"{self.name} has no task {name!r:.120}{of}{nearest(name, there)}")
        if len(found) > 1:
            suites = ", ".join(t.suite for t in found)
            raise ScenarioError(
                f"{len(found)} suites of {self.name} have a task {name!r:.120} ({suites}): name the suite"
            )
        said = instruction or found[0].instruction
        return Task(self.name, found[0].suite, found[0].name, said, found[0].horizon)

    def task_by_instruction(self, instruction: str, suite: str = "") -> Task:
        """A task by its instruction, letter case and spaces aside.

        Raises:
            ScenarioError: no task has it, or several have.
        """
        wanted = _plain(instruction)
        found = [t for t in self.tasks() if _plain(t.instruction) == wanted and suite in ("", t.suite)]
        if len(found) != 1:
            raise ScenarioError(
                f"{len(found)} tasks of {self.name} have the instruction {instruction!r:.120}"
                + (f": {', '.join(f'{t.suite}/{t.name}' for t in found)}" if found else "")
                + "; name the task (--task NAME) or the suite (--suite)"
            )
        return self.task(found[0].name, instruction, found[0].suite)

    def check_task(self, task: Task) -> None:
        """Refuses a task that the platform does not have.

        Raises:
            ScenarioError: unknown suite or task; names the nearest ones.
            SimulatorError: what the catalogue is read from is not installed.
        """
        suites: dict[str, set[str]] = defaultdict(set)
        for known in self.tasks():
            suites[known.suite].add(known.name)
        if task.suite not in suites:
            raise ScenarioError(f"{self.name} has no suite {task.suite!r}; there are {', '.join(suites)}")
        if task.name not in suites[task.suite]:
            elsewhere = [s for s, names in suites.items() if task.name in names]
            hint = (
                f"; it is a task of {elsewhere[0]}" if elsewhere else nearest(task.name, suites[task.suite])
            )
            raise ScenarioError(f"{self.name} suite {task.suite} has no task {task.name!r}{hint}")


def _plain(text: str) -> str:
    return " ".join(text.lower().split())


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
