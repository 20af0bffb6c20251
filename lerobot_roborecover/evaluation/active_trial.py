"""A seat of the engine: a slot, and the trial that sits in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from lerobot_roborecover.evaluation.trial import Trial
from lerobot_roborecover.evaluation.trial_state import TrialState
from lerobot_roborecover.evaluation.videos import VideoWriter
from lerobot_roborecover.evaluation.work_items import WorkItem
from lerobot_roborecover.policies.runner import Replica
from lerobot_roborecover.scenario import TrialStart
from lerobot_roborecover.workers.messages import Reply


class EngineSlot(Protocol):
    """Where a simulator lives: `opening`, `ready` and `opened` as `host.Replica` has them."""

    @property
    def opening(self) -> bool:
        """Whether it cannot be asked yet."""

    @property
    def ready(self) -> Any:
        """What the engine's wait function waits on for the reply; True where it is there already."""

    @property
    def deadline(self) -> float:
        """When the command under way counts as hung, on the engine's clock."""

    def opened(self) -> None:
        """Finds out whether the opening has worked."""

    def send(self, command: str, argument: object = None) -> None:
        """Starts a command."""

    def receive(self) -> Reply:
        """Its reply."""


@dataclass(eq=False)
class WorkerState:
    """A slot and who sits there."""

    slot: EngineSlot
    last: WorkItem[TrialStart] | None = None
    """Who sat there last, or sits there."""
    sitting: ActiveTrial | None = None
    """None where it is idle."""


@dataclass(eq=False)
class ActiveTrial:
    """A trial in its seat."""

    seat: WorkerState
    unit: WorkItem[TrialStart]
    trial: Trial
    """Of `unit`."""
    replica: Replica | None
    """Who has the trial's history; None once that is lost."""
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
