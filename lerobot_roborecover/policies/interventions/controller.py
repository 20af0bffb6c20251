"""Chooses the controller of every slot at every step; both evaluation loops use this implementation.

For each slot that needs an action:

1. Until the trial's intervention, the monitor scores the observation; without a monitor the intervention
   comes at once. A trial has at most one intervention.
2. `reversion` requests a rollback, after which the base policy continues with fresh history. `correction` and
   `human` take over with fresh history, for some steps or until the person hands back.
3. Where the slot's queue is empty, its controller infers an action chunk. All slots of one policy share a
   batch.
4. While the monitor must see every step, one action leaves the queue at a time; otherwise all of them.

The slots' queues, histories and random streams are independent of each other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from lerobot_roborecover.policies.detectors.interface import Detector, DetectorHistory
from lerobot_roborecover.policies.detectors.online import OnlineDetector
from lerobot_roborecover.policies.detectors.probe import PolicyProbe
from lerobot_roborecover.policies.interventions.members import MemberHost
from lerobot_roborecover.policies.interventions.takeover import TakeoverController
from lerobot_roborecover.policies.runner import Act, Controller, InterventionMark, PolicyError, Rollback

type Observation = Mapping[str, torch.Tensor]
"""After the env preprocessor, batch axis of 1."""


@dataclass(eq=False)
class InterventionState:
    """State of one trial in the composite policy. Apart from `PolicyState`, which every member has of its
    own."""

    seed: int | None
    pending: bool
    """An intervention may still come."""
    controller: Controller = Controller.BASE
    history: Any = None
    """History of the acting policy, or the driver's name of the slot."""
    stream: list[torch.Tensor] | None = None
    """The trial's random stream, while no policy has it."""
    queue: np.ndarray | None = None
    """(n, A) actions still to be executed."""
    left: int = 0
    """Steps that the correction policy still has."""
    mark: InterventionMark = field(default_factory=InterventionMark)
    """Mark of the next action."""
    watch: DetectorHistory | None = None
    """The monitor's history of the trial; None without a monitor."""


class InterventionController:
    """Runs the member policies and switches between them.

    Args:
        members: the policies by controller; includes `Controller.BASE`.
        mode: of the composite policy.
        monitor: the detector that decides when; None intervenes at the recovery point.
        probe: into the base policy, for a detector that looks into it.
        takeover: the person, for mode `human`.
        correction_steps: of the correction policy.
        rewind_steps: of a rollback; None follows the paper's rule.
    """

    def __init__(
        self,
        members: Mapping[Controller, MemberHost],
        mode: str,
        *,
        monitor: Detector | None = None,
        probe: PolicyProbe | None = None,
        takeover: TakeoverController | None = None,
        correction_steps: int = 30,
        rewind_steps: int | None = None,
    ):
        self.members = dict(members)
        self._mode, self._takeover = mode, takeover
        self._watcher = None if monitor is None else OnlineDetector(monitor, probe)
        self._correction_steps = correction_steps
        self._rewind_steps = rewind_steps
        self.action_width = self.members[Controller.BASE].action_width

    def start(self, seed: int | None) -> InterventionState:
        """Starts a trial under the base policy.

        Args:
            seed: the trial's; None where the run has none, or where torch's own generator is seeded for it.
        """
        episode = InterventionState(seed, pending=self._mode != "direct")
        episode.watch = self._watcher.start(seed) if self._watcher else None
        episode.history = self.members[Controller.BASE].start(seed)
        return episode

    def finish(self, episode: InterventionState) -> None:
        self._leave(episode)

    def act(
        self,
        observations: Sequence[Observation],
        instructions: Sequence[str],
        episodes: Sequence[InterventionState],
    ) -> list[Act | Rollback | PolicyError]:
        """Returns decisions with marks for slots that have no action left to execute.

        Args:
            observations: of each slot.
            instructions: of their tasks.
            episodes: their trials, updated here.

        Returns:
            One decision per slot. Where a member raised, its error instead.
        """
        out: list[Act | Rollback | PolicyError | None] = [None] * len(episodes)
        self._watch(observations, instructions, episodes, out)
        # A controller that hands its slot back is followed by the base policy in the same step.
        for controller in (Controller.HUMAN, Controller.CORRECTION, Controller.BASE):
            due = [
                i
                for i, e in enumerate(episodes)
                if out[i] is None and e.queue is None and e.controller is controller
            ]
            if not due:
                continue
            if controller is Controller.HUMAN:
                chunks = [self._driven(observations[i], instructions[i], episodes[i]) for i in due]
            else:
                chunks = self.members[controller].act(
                    [observations[i] for i in due],
                    [instructions[i] for i in due],
                    [episodes[i].history for i in due],
                )
            for i, chunk in zip(due, chunks, strict=True):
                if isinstance(chunk, PolicyError):
                    out[i] = PolicyError(f"{controller.name.lower()}: {chunk}")
                else:
                    episodes[i].queue = chunk
        return [self._next(e) if o is None else o for e, o in zip(episodes, out, strict=True)]

    # --- when

    def _watch(
        self,
        observations: Sequence[Observation],
        instructions: Sequence[str],
        episodes: Sequence[InterventionState],
        out: list[Act | Rollback | PolicyError | None],
    ) -> None:
        pending = [i for i, e in enumerate(episodes) if e.pending]
        fires = dict.fromkeys(pending, True)
        if self._watcher is not None and pending:
            size = self._watcher.max_batch
            for at in range(0, len(pending), size):
                part = pending[at : at + size]
                began = time.perf_counter()
                try:
                    verdicts = self._watcher.judge(
                        [w for i in part if (w := episodes[i].watch) is not None],
                        [{k: v[0] for k, v in observations[i].items()} for i in part],
                        [instructions[i] for i in part],
                    )
                except Exception as err:  # as with policies: whatever a monitor raises costs its trials alone
                    for i in part:
                        out[i] = PolicyError(f"monitor: {type(err).__name__}: {err}")
                        fires[i] = False
                    continue
                seconds = (time.perf_counter() - began) / len(part)
                for i, score, trigger in zip(part, verdicts.scores, verdicts.triggers, strict=True):
                    fires[i] = bool(trigger) and not np.isnan(score)
                    episodes[i].mark = InterventionMark(episodes[i].controller, True, float(score), seconds)
        for i in pending:
            if fires[i]:
                out[i] = self._intervene(episodes[i], instructions[i])

    def _intervene(self, episode: InterventionState, instruction: str) -> Rollback | None:
        """Hands the slot over; the rollback itself, where that is what it takes."""
        episode.pending = False
        told = episode.mark
        if self._mode.endswith("reversion"):
            self._hand_over(episode, Controller.BASE)
            episode.mark = InterventionMark()
            return Rollback(self._rewind_steps, replace(told, controller=Controller.BASE))
        taker = Controller.HUMAN if self._mode == "human" else Controller.CORRECTION
        self._hand_over(episode, taker)
        if taker is Controller.HUMAN:
            episode.history = self._person().take(instruction)
        else:
            episode.left = self._correction_steps
        episode.mark = replace(told, controller=taker)
        return None

    # --- who

    def _leave(self, episode: InterventionState) -> None:
        if episode.history is None:
            return
        if episode.controller is Controller.HUMAN:
            self._person().leave(episode.history)
        else:
            episode.stream = episode.history.stream
            self.members[episode.controller].finish(episode.history)
        episode.history = None

    def _hand_over(self, episode: InterventionState, controller: Controller) -> None:
        """Gives the new controller fresh history and an empty queue; the trial's random stream goes on."""
        self._leave(episode)
        episode.controller, episode.queue = controller, None
        if controller in self.members:
            episode.history = self.members[controller].start(None)
            episode.history.stream = episode.stream

    def _person(self) -> TakeoverController:
        if self._takeover is None:
            raise RuntimeError(f"mode {self._mode} needs a controller")
        return self._takeover

    def _driven(
        self, observation: Observation, instruction: str, episode: InterventionState
    ) -> np.ndarray | PolicyError | None:
        """The person's next action; None where they have handed the slot back."""
        alone = {k: v[0] if isinstance(v, torch.Tensor) else v for k, v in observation.items()}
        action = self._person().act(episode.history, alone)
        if action is None:
            # The queue stays empty: the base policy is asked in the same step.
            self._hand_over(episode, Controller.BASE)
            episode.mark = replace(episode.mark, controller=Controller.BASE)
            return None
        action = np.asarray(action)
        if action.shape != (self.action_width,) or not np.issubdtype(action.dtype, np.floating):
            return PolicyError(
                f"the person's action is {action.dtype} {action.shape}, not floats ({self.action_width},)"
            )
        return action[None]

    def _next(self, episode: InterventionState) -> Act:
        """Returns the actions to execute before the slot's next inference."""
        queue = episode.queue
        assert queue is not None
        take = len(queue)
        if episode.controller is Controller.CORRECTION:
            take = min(take, episode.left)
        if episode.pending and self._watcher is not None:
            take = 1
        decision = Act(np.ascontiguousarray(queue[:take]), episode.mark)
        episode.queue = queue[take:] if take < len(queue) else None
        episode.mark = InterventionMark(episode.controller)
        if episode.controller is Controller.CORRECTION:
            episode.left -= take
            if not episode.left:
                self._hand_over(episode, Controller.BASE)
                episode.mark = InterventionMark()
        return decision
