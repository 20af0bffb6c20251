"""State machine of one trial, from its reset to its row, shared by both evaluation loops.

    NEW -> HANDING_OFF -> WAITING -> ASKED -> ACTING -> WAITING ... -> OVER
                                           -> ROLLING_BACK -> WAITING

1. `begin` returns what a simulator needs to rebuild the start. The simulator replays, compares and observes.
2. `ask` returns the observation for the policy. After an unfaithful handoff the trial ends before this step,
   so the policy sees nothing of it.
3. `on_actions` takes the policy's actions, or its request for a rollback. It rejects a bad action, which is
   never sent.
4. `on_reply` takes the simulator's reply. It counts steps and hashes actions; the task's predicate decides
   success.
5. `OVER` has an outcome: success, horizon reached, or the reason why the trial is invalid. `row` returns it.

`skip` and `fail` end a trial in any state. The state machine has no clock, process or file. Two loops drive
it: `evaluation.vector_env` (LeRobot's loop) one action at a time, and `evaluation.scheduler` chunk by chunk.
The same policy gives the same row in both, because a chunk counts as its single actions. In real-time
evaluation (`real_time`), `on_actions` puts the actions executed during the inference before the policy's
actions.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any
from typing import Protocol as Interface

import numpy as np

from lerobot_roborecover.evaluation.intervention_record import InterventionRecord
from lerobot_roborecover.evaluation.real_time import LatencyModel, RealTime
from lerobot_roborecover.logs.row import (
    EvalProtocol,
    RunExtent,
    TrialRow,
    actions_digest,
    make_row,
    trial_key,
    trial_seed,
)
from lerobot_roborecover.platforms import resolve_rewind_steps
from lerobot_roborecover.policies.action_checks import action_problem, chunk_problem
from lerobot_roborecover.policies.runner import Act, Decision, InterventionMark, Rollback, decision_of
from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.scenario import Outcome, TrialStart
from lerobot_roborecover.workers.messages import (
    ActResult,
    EpisodeSpec,
    EpisodeStart,
    Reply,
    RollbackReply,
    SlotFailure,
)

FAILURES = {
    "raised": Outcome.SIM_ERROR,
    "died": Outcome.SIM_ERROR,
    "hung": Outcome.TIMEOUT,
    "lost": Outcome.SIM_ERROR,
}
"""Outcome of a trial by the kind of its slot's failure; a `lost` trial is first run again elsewhere."""

SOLVED_THERE = "the task's predicate already holds where the rollback went"


class TrialState(StrEnum):
    NEW = "new"
    """No request has been sent yet."""
    HANDING_OFF = "handing_off"
    """A simulator rebuilds its start."""
    WAITING = "waiting"
    """It has an observation that the policy has not received yet."""
    ASKED = "asked"
    """The policy infers."""
    ACTING = "acting"
    """A simulator executes actions."""
    ROLLING_BACK = "rolling_back"
    """A simulator is rolled back to an earlier state."""
    OVER = "over"
    """It has an outcome, or was skipped."""


IN_SIMULATOR = (TrialState.HANDING_OFF, TrialState.ACTING, TrialState.ROLLING_BACK)
"""States that a simulator's reply ends."""


class PolicyStateFactory(Interface):
    """Creates a policy's history for a trial (`policies.runner`)."""

    def start(self, seed: int | None) -> Any:
        """Returns fresh history for a trial with this seed."""


class Trial:
    """One trial of one policy on one scenario.

    Args:
        scenario: the start to rebuild.
        index: k, number of the trial within its scenario, from 0.
        protocol: settings that are fixed for the run.
        action_width: A, values in the policy's action.
        handoff_check: compare the handoff with the scenario's fingerprint.
        rollback_steps: most steps that a rollback may be requested for.
        real_time: cost of an inference in steps; None: the simulator waits during inferences.
    """

    def __init__(
        self,
        scenario: TrialStart,
        index: int,
        protocol: EvalProtocol,
        *,
        action_width: int,
        handoff_check: bool = True,
        rollback_steps: int = 0,
        real_time: RealTime | None = None,
    ):
        self.scenario, self.index, self.protocol = scenario, index, protocol
        self.state = TrialState.NEW
        self.observation: dict[str, Any] | None = None
        """The last one there is, unbatched."""
        self.handoff: Handoff | None = None
        self.outcome: Outcome | None = None
        """None until it is over, and where it was skipped."""
        self.reason = ""
        self.success = False
        self.steps = 0
        """New environment steps; replayed ones do not count. Within S once it is over."""
        self.attachment = b""
        """What the simulator's side has made of it once it is over, see `ActResult`."""
        self._action_width, self._check, self._rollback_steps = action_width, handoff_check, rollback_steps
        self._sim_s = self._policy_s = 0.0
        self._executed: list[np.ndarray] = []
        self._progress: list[int] = []
        self._record = InterventionRecord()
        self._real_time = real_time
        self._clock: LatencyModel | None = None
        self._sent = np.empty((0, action_width))
        self._mark: InterventionMark | None = None

    @property
    def key(self) -> tuple:
        """Its identity in a trial log."""
        hash_ = self.protocol.config_hash()
        return trial_key(self.scenario.sha256(), self.scenario.id, hash_, self.index)

    @property
    def seed(self) -> int | None:
        """Of its randomness; None where the run has none."""
        return trial_seed(self.protocol.run_seed, self.scenario.id, self.index)

    @property
    def over(self) -> bool:
        """Whether nothing more happens in it."""
        return self.state is TrialState.OVER

    @property
    def in_simulator(self) -> bool:
        """Whether a simulator's reply is due."""
        return self.state in IN_SIMULATOR

    def open_history(self, host: PolicyStateFactory) -> Any:
        """What the policy side keeps for it: fresh, with its random stream."""
        return host.start(self.seed)

    # --- its life

    def begin(self, record_video: bool = False) -> EpisodeSpec:
        """Starts it: what a simulator needs for the handoff.

        Args:
            record_video: replies are to bring frames for a video.
        """
        self._leave(TrialState.NEW, to=TrialState.HANDING_OFF)
        return EpisodeSpec(
            self.scenario,
            self.protocol.start,
            self.protocol.rewind_for(self.scenario),
            self._check,
            record_video,
            self._rollback_steps,
        )

    def ask(self) -> dict[str, Any]:
        """The observation, for the policy."""
        self._leave(TrialState.WAITING, to=TrialState.ASKED)
        assert self.observation is not None
        return self.observation

    def on_actions(self, decision: Decision, *, seconds: float) -> Act | Rollback | None:
        """Takes the policy's answer in.

        Args:
            decision: actions, or a rollback. A bad action ends the trial when it comes up, if it does.
            seconds: that the policy took, those of a shared batch in full.

        Returns:
            What the simulator is to do: good actions, or a rollback by a number of steps. None where the
            trial is over instead.
        """
        self._leave(TrialState.ASKED, to=TrialState.ACTING)
        self._policy_s += seconds
        decision = decision_of(decision)
        if isinstance(decision, Rollback):
            return self._roll_back(decision)
        actions, self._mark = decision.actions, decision.mark
        problem = chunk_problem(self.scenario, actions, self._action_width)
        if problem:
            self._end(Outcome.POLICY_ERROR, f"at step {self.steps}: {problem}")
            return None
        if self._clock is not None:
            actions = self._clock.sequence(actions, seconds)
        self._sent = actions
        if self._mark is not None:
            self._record.note(decision, self._mark, self.steps)
        good = 0
        while good < len(actions) and not self._problem(actions[good]):
            good += 1
        if good:
            return Act(actions[:good])
        self._end(Outcome.POLICY_ERROR, self._problem(actions[0]))
        return None

    def on_policy_error(self, why: object, *, seconds: float) -> None:
        """The policy raised in place of an answer.

        Args:
            why: its error.
            seconds: that it took.
        """
        self._leave(TrialState.ASKED, to=TrialState.OVER)
        self._policy_s += seconds
        self._end(Outcome.POLICY_ERROR, f"at step {self.steps}: {why}")

    def on_reply(self, reply: Reply) -> None:
        """Takes the simulator's reply in."""
        if isinstance(reply, SlotFailure):
            self._leave(*IN_SIMULATOR, to=TrialState.OVER)
            where = f"at step {self.steps}" if self.handoff else "at the handoff"
            self._end(FAILURES[reply.kind], f"{where}: {reply.message}")
        elif isinstance(reply, EpisodeStart):
            self._leave(TrialState.HANDING_OFF, to=TrialState.WAITING)
            self.observation, self.handoff = reply.observation, reply.handoff
            if reply.progress is not None:
                self._progress = [percent(reply.progress)]
            if self._real_time is not None:
                self._clock = LatencyModel(self._real_time, reply.hz)
            if reply.handoff.problem is not None:
                self._end(reply.handoff.problem, reply.handoff.reason)
        elif isinstance(reply, RollbackReply):
            self._leave(TrialState.ROLLING_BACK, to=TrialState.WAITING)
            self._record.rolled_back(reply)
            self._sim_s += reply.seconds
            self.observation = reply.observation
            if reply.progress is not None:
                self._progress[-1:] = [percent(reply.progress)]
            if reply.solved:
                self._end(Outcome.SOLVED_BY_PREFIX, SOLVED_THERE)
        elif isinstance(reply, ActResult):
            self._leave(TrialState.ACTING, to=TrialState.WAITING)
            self._acted(reply)
        else:
            raise TypeError(f"{self}: a {type(reply).__name__} is no reply to a command of a trial")

    def fail(self, outcome: Outcome, reason: str) -> None:
        """Ends it wherever it is, for a reason from outside."""
        self._leave(*(s for s in TrialState if s is not TrialState.OVER), to=TrialState.OVER)
        self._end(outcome, reason)

    def skip(self, *, success: bool = False, steps: int = 0) -> None:
        """Ends it before it begins, without a row: an earlier run finished it, or it was not requested.

        Args:
            success: how it ended then.
            steps: after how many.
        """
        self._leave(TrialState.NEW, to=TrialState.OVER)
        self.success, self.steps = success, steps

    def verdict(self) -> Outcome:
        """How it ended.

        Raises:
            RuntimeError: it is not over, or was skipped.
        """
        if self.outcome is None:
            raise RuntimeError(f"{self} has no outcome yet")
        return self.outcome

    @property
    def actions(self) -> np.ndarray:
        """(n, A), what was executed, of the type that the policy gave: replaying it is exact only in that
        type."""
        return np.stack(self._executed) if self._executed else np.empty((0, self._action_width), np.float32)

    def row(
        self,
        *,
        dataset: str,
        dataset_revision: str | None,
        noise: str,
        batch_size: int,
        extent: RunExtent | None = None,
    ) -> TrialRow:
        """Its row.

        Args:
            dataset: where the scenario came from.
            dataset_revision: and which version of it.
            noise: how the policy's noise was drawn, see `TrialRow.noise`.
            batch_size: trials that shared a policy batch, at most.
            extent: how much its run was to evaluate.

        Raises:
            RuntimeError: it is not over, or was skipped.
        """
        return make_row(
            self.scenario,
            self.protocol,
            dataset=dataset,
            dataset_revision=dataset_revision,
            trial=self.index,
            noise=noise,
            batch_size=batch_size,
            outcome=self.verdict(),
            reason=self.reason,
            steps=self.steps,
            handoff=self.handoff,
            sim_s=self._sim_s,
            policy_s=self._policy_s,
            actions_sha256=actions_digest(self._executed),
            interventions=self._record.entries(),
            progress=self._progress or None,
            extent=extent,
        )

    def __repr__(self) -> str:
        return f"trial {self.index} of {self.scenario.id} ({self.state})"

    # --- inside

    def _acted(self, reply: ActResult) -> None:
        steps = reply.steps
        self._sim_s += reply.seconds
        sent = self._sent[:steps]
        self._executed += [np.array(action) for action in sent]
        if self._mark is not None:
            self._record.acted(self._mark.controller, len(sent))
        self.steps += steps
        self._progress += map(percent, reply.progress)
        if reply.observation is not None:
            self.observation = reply.observation
        self.attachment = reply.attachment
        if reply.success:
            self._record.solved()
        if reply.over:
            outcome, self.steps = self._record.verdict(self.steps, self.scenario.task.horizon)
            self._end(outcome)
        elif steps < len(self._sent):
            self._end(Outcome.POLICY_ERROR, self._problem(self._sent[steps]))

    def _roll_back(self, decision: Rollback) -> Rollback | None:
        """The rollback by a number of steps, which is all that a simulator's worker takes."""
        if decision.steps is not None and decision.steps < 1:
            text = f"the policy asked for a rollback of {decision.steps} steps; it must be 1 or more"
            self._end(Outcome.POLICY_ERROR, f"at step {self.steps}: {text}")
            return None
        self._record.note(decision, decision.mark, self.steps)
        self.state = TrialState.ROLLING_BACK
        return Rollback(resolve_rewind_steps(self.scenario, decision.steps), decision.mark)

    def _problem(self, action: np.ndarray) -> str:
        return action_problem(self.scenario, action, self._action_width)

    def _end(self, outcome: Outcome, reason: str = "") -> None:
        self.state, self.outcome, self.reason = TrialState.OVER, outcome, reason
        self.steps = min(self.steps, self.scenario.task.horizon)  # steps that were taken back come on top
        self.success = outcome is Outcome.SUCCESS

    def _leave(self, *states: TrialState, to: TrialState) -> None:
        if self.state not in states:
            raise RuntimeError(f"{self} cannot become {to}: that follows {' or '.join(states)} only")
        self.state = to


def percent(share: float) -> int:
    """Progress as rows have it: whole per cent, and 100 for nothing less than all."""
    return 100 if share >= 1.0 else min(max(round(100 * share), 0), 99)
