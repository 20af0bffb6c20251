"""Units of work, and which slot takes which: a slot stays with a scenario, then with a task, as long as it
can."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lerobot_roborecover.scenario import Scenario, TrialStart

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.session import EvalSession


@dataclass(frozen=True)
class WorkItem[S: TrialStart]:
    """One trial to run."""

    scenario: S
    trial: int

    @property
    def task(self) -> tuple[str, str]:
        """What decides the compiled model."""
        return self.scenario.task.suite, self.scenario.task.name


def units_of(scenarios: Iterable[Scenario], trials: int) -> list[WorkItem[Scenario]]:
    """Returns all trials of all scenarios."""
    return [WorkItem(s, k) for s in scenarios for k in range(trials)]


def unfinished[S: TrialStart](run: EvalSession, units: Sequence[WorkItem[S]]) -> list[WorkItem[S]]:
    """Returns the units that the run's trial log does not hold yet."""
    if run.log is None:
        return list(units)
    keys = run.keys([(u.scenario, u.trial) for u in units])
    return [u for u, key in zip(units, keys, strict=True) if run.log.find(key) is None]


def first_units(
    units: Iterable[WorkItem], slots: int, queue_of: type[WorkQueue] | None = None
) -> list[WorkItem]:
    """What so many idle slots take first, in their order; fewer where there are not as many units."""
    queue = (queue_of or WorkQueue)(units)
    taken: list[WorkItem] = []
    while len(taken) < slots and (unit := queue.take(None, [u.task for u in taken])) is not None:
        taken.append(unit)
    return taken


class WorkQueue:
    """Hands out units so that a slot meets the same scenario, then the same task, again.

    A slot that has to change task takes the one with the most units left, so that no slot is left alone with
    a long task at the end. The order decides speed alone: a trial's result does not depend on it.

    Args:
        units: what is to be run.
    """

    def __init__(self, units: Iterable[WorkItem]):
        self._tasks: OrderedDict[tuple[str, str], OrderedDict[str, deque[WorkItem]]] = OrderedDict()
        self._left = 0
        for unit in units:
            self._of(unit).append(unit)
            self._left += 1

    def __len__(self) -> int:
        return self._left

    def take(self, last: WorkItem | None, busy: Iterable[tuple[str, str]] = ()) -> WorkItem | None:
        """The next unit for a slot, or None when there is none.

        Args:
            last: the slot's previous unit.
            busy: tasks that other slots are at; a slot that changes task avoids them while others wait.
        """
        if not self._left:
            return None
        if last is not None and last.task in self._tasks:
            task = last.task
        else:
            occupied = set(busy)
            free = [t for t in self._tasks if t not in occupied] or list(self._tasks)
            task = max(free, key=lambda t: sum(map(len, self._tasks[t].values())))
        scenarios = self._tasks[task]
        name = (
            last.scenario.id if last is not None and last.scenario.id in scenarios else next(iter(scenarios))
        )
        unit = scenarios[name].popleft()
        self._left -= 1
        if not scenarios[name]:
            del scenarios[name]
        if not scenarios:
            del self._tasks[task]
        return unit

    def put_back(self, unit: WorkItem) -> None:
        """Takes a unit in again, first of its scenario."""
        self._of(unit).appendleft(unit)
        self._left += 1

    def _of(self, unit: WorkItem) -> deque[WorkItem]:
        return self._tasks.setdefault(unit.task, OrderedDict()).setdefault(unit.scenario.id, deque())

    def drop(self, scenario_id: str) -> list[WorkItem]:
        """Takes out every unit left of a scenario."""
        dropped: list[WorkItem] = []
        for task in list(self._tasks):
            dropped += self._tasks[task].pop(scenario_id, ())
            if not self._tasks[task]:
                del self._tasks[task]
        self._left -= len(dropped)
        return dropped


class OrderedQueue(WorkQueue):
    """Hands out units in the order given, whatever the slot: for a run that may stop at any of them.

    Args:
        units: what is to be run.
    """

    def __init__(self, units: Iterable[WorkItem]):
        super().__init__(())
        self._units = deque(units)

    def __len__(self) -> int:
        return len(self._units)

    def take(self, last: WorkItem | None, busy: Iterable[tuple[str, str]] = ()) -> WorkItem | None:
        """The next unit of all, or None when there is none."""
        return self._units.popleft() if self._units else None

    def put_back(self, unit: WorkItem) -> None:
        """Takes a unit in again, as the next one."""
        self._units.appendleft(unit)

    def drop(self, scenario_id: str) -> list[WorkItem]:
        """Takes out every unit left of a scenario."""
        dropped = [u for u in self._units if u.scenario.id == scenario_id]
        self._units = deque(u for u in self._units if u.scenario.id != scenario_id)
        return dropped
