"""A platform's tasks, and how they are found by name or instruction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from lerobot_roborecover.platforms.names import nearest
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
