"""What intervened in a trial, as it was carried out: the row's `interventions`, and how its steps count.

The paper gives a trial S new environment steps; replayed actions do not count. Actions that the policy took
and a rollback undid were taken: by default they stay counted, so a rollback costs the steps it throws away.
The other reading gives them back. A trial with a rollback therefore runs on for as many steps as were undone,
and its row says what happened in them: `solved_in_extra` turns its `horizon` into a success under the other
reading, and nothing else changes (docs/interventions.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from lerobot_roborecover.policies.runner import BY_RULE, Act, Controller, InterventionMark, Rollback
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.workers.messages import RollbackReply

_KINDS = {Controller.CORRECTION: "correction", Controller.HUMAN: "takeover"}


@dataclass
class InterventionRecord:
    """Follows one trial: the row's interventions alone, apart from `Trial`, which counts the rest. `steps`
    are always new environment steps taken so far, undone ones included."""

    undone: int = 0
    """Steps of the policy that rollbacks threw away."""
    _monitor: dict[str, Any] = field(default_factory=dict)
    """The row's entry of the monitor; empty until it is asked. `step` is that of the trigger, `score` the
    last one up to the trigger."""
    _entries: list[dict[str, Any]] = field(default_factory=list)
    _controller: Controller = Controller.BASE
    _solved: bool = False

    def note(self, decision: Act | Rollback, mark: InterventionMark, steps: int) -> None:
        """Takes a decision and its mark in, before it is carried out."""
        changes, back = mark.controller is not self._controller, isinstance(decision, Rollback)
        by = "schedule"
        if mark.asked:
            self._heard(mark)
            if (back or changes) and self._monitor["step"] is None:
                self._monitor["step"], by = steps, "monitor"
        if isinstance(decision, Rollback):
            asked = BY_RULE if decision.steps is None else decision.steps
            self._entries.append({"kind": "rollback", "step": steps, "by": by, "asked": asked})
        elif changes and mark.controller in _KINDS:
            kind = _KINDS[mark.controller]
            self._entries.append({"kind": kind, "step": steps, "by": by, "steps": 0})
        self._controller = mark.controller

    def _heard(self, mark: InterventionMark) -> None:
        told = self._monitor = self._monitor or {
            "kind": "monitor", "step": None, "calls": 0, "unparsable": 0,
            "score": None, "highest_score": None, "seconds": 0.0,
        }  # fmt: skip
        told["calls"] += 1
        told["seconds"] += mark.monitor_s
        if math.isnan(mark.score):
            told["unparsable"] += 1
            return
        if told["step"] is None:
            told["score"] = mark.score
        highest = told["highest_score"]
        told["highest_score"] = mark.score if highest is None else max(mark.score, highest)

    def acted(self, controller: Controller, steps: int) -> None:
        """Counts executed actions for the controller that chose them."""
        if controller in _KINDS:
            self._entries[-1]["steps"] += steps

    def rolled_back(self, result: RollbackReply) -> None:
        """Fills in the rollback that was just noted."""
        self.undone += result.undone
        self._entries[-1] |= {
            "distance": result.distance,
            "undone": result.undone,
            "method": result.method,
            "seconds": round(result.seconds, 4),
        }

    def add(self, entry: dict[str, Any]) -> None:
        """Takes in what was done to the trial from outside; has at least `kind` and `step`."""
        self._entries.append(entry)

    def verdict(self, steps: int, horizon: int) -> tuple[Outcome, int]:
        """Outcome and counted steps of a trial that was solved, or that used its budget up.

        Args:
            steps: at which it was solved; S and as many as were undone, or more, where it was not.
            horizon: S.
        """
        solved = self._solved
        if self.undone:
            last = [e for e in self._entries if e["kind"] == "rollback"][-1]
            last["extra_steps"] = max(steps - horizon, 0)
            last["solved_in_extra"] = solved and steps > horizon
        outcome = Outcome.SUCCESS if solved and steps <= horizon else Outcome.HORIZON
        return outcome, min(steps, horizon)

    def solved(self) -> None:
        """The task's predicate holds."""
        self._solved = True

    def entries(self) -> list[dict[str, Any]]:
        """The row's `interventions`, the monitor's entry first."""
        if not self._monitor:
            return list(self._entries)
        digits = {"score": 6, "highest_score": 6, "seconds": 4}
        monitor = {
            k: v if v is None else round(v, digits[k]) if k in digits else v for k, v in self._monitor.items()
        }
        return [monitor, *self._entries]
