"""A simulator worker, and the trial that runs in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot_roborecover.evaluation.trial import Trial, TrialState
from lerobot_roborecover.evaluation.videos import VideoWriter
from lerobot_roborecover.evaluation.work_items import WorkItem
from lerobot_roborecover.policies.runner import Replica
from lerobot_roborecover.scenario import TrialStart
from lerobot_roborecover.workers.slots import SimulatorWorker


@dataclass(eq=False)
class WorkerState:
    slot: SimulatorWorker
    last: WorkItem[TrialStart] | None = None
    """The last or current work item."""
    active: ActiveTrial | None = None
    """None where it is idle."""


@dataclass(eq=False)
class ActiveTrial:
    """A trial that runs in a worker."""

    worker: WorkerState
    unit: WorkItem[TrialStart]
    trial: Trial
    """Trial of `unit`."""
    replica: Replica | None
    """The replica that has the trial's history; None once that is lost."""
    history: Any
    waiting_since: float = 0.0
    answered_at: float | None = None
    """When the policy last answered, on the engine's clock; None before the first time."""
    answered_with: int = 0
    """Trials that were answered then."""
    recording: VideoWriter | None = None

    @property
    def working(self) -> bool:
        """Whether its slot owes a reply."""
        return self.trial.in_simulator

    @property
    def waiting(self) -> bool:
        """Whether the policy is to be asked about it."""
        return self.trial.state is TrialState.WAITING
