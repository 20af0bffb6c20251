"""What a run says of a composite policy: who is in it, and what makes its trials its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lerobot_roborecover.platforms import resolve_rewind_steps
from lerobot_roborecover.scenario import TrialStart

POLICY_TYPE = "roborecover_intervention"
MODES = ("direct", "reversion", "correction", "monitor_reversion", "monitor_correction", "human")
MEMBERS = ("base", "correction", "monitor")
_ROLLS_BACK = ("reversion", "monitor_reversion")


@dataclass(frozen=True)
class InterventionFacts:
    """A composite policy, as the trial rows need it."""

    mode: str
    rewind_steps: int | None = None
    """None: by the paper's rule for the task."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What else decides a result, by option name; members by content."""

    @property
    def rolls_back(self) -> bool:
        """Whether the mode asks for rollbacks."""
        return self.mode in _ROLLS_BACK

    def rollback_steps(self, scenario: TrialStart) -> int:
        """Returns the most steps that it may roll back on a scenario; 0 without rollback."""
        return resolve_rewind_steps(scenario, self.rewind_steps) if self.rolls_back else 0

    def name(self) -> str:
        """The composite policy in trial rows: `BASE monitor_correction(CORRECTION, MONITOR)`."""
        others = ", ".join(self.settings[m] for m in MEMBERS[1:] if self.settings.get(m))
        return f"{self.settings['base']} {self.mode}" + (f"({others})" if others else "")

    def options(self) -> dict[str, Any]:
        """For `Protocol.options`: everything that decides a result."""
        found = {"intervention": self.mode, **{f"intervention_{k}": v for k, v in self.settings.items()}}
        if self.rolls_back:
            found["intervention_rewind_steps"] = "paper" if self.rewind_steps is None else self.rewind_steps
        return found
