"""A seat of the engine: a slot, and the trial it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot_roborecover.env.trial import Trial, TrialState
from lerobot_roborecover.policies.host import Replica
from lerobot_roborecover.trials.units import Unit
from lerobot_roborecover.trials.videos import Recording


@dataclass(eq=False)
class Seat:
    """A slot and the trial it runs; idle where it runs none."""

    slot: Any
    unit: Unit | None = None
    trial: Trial | None = None
    """Of `unit`."""
    last: Unit | None = None
    replica: Replica | None = None
    """Who has the trial's history; None once that is lost."""
    history: Any = None
    waiting_since: float = 0.0
    recording: Recording | None = None

    @property
    def working(self) -> bool:
        """Whether its slot owes a reply."""
        return self.trial is not None and self.trial.in_simulator

    @property
    def waiting(self) -> bool:
        """Whether the policy is to be asked about it."""
        return self.trial is not None and self.trial.state is TrialState.WAITING
