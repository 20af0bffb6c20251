"""A trial that begins in the middle of a logged one.

The state is rebuilt by replaying: the prefix to the handoff, which is compared with the scenario's
fingerprint as ever, then the logged actions, in the type in which they were executed. None of it counts
again: the fork has the steps that the logged trial had left.

Where the same policy continues, its history is rebuilt, too: the trial runs from its handoff with its own
seed, the policy is asked about what it saw then, and the logged actions are executed in place of its answers,
which must be the same. At the fork's step nothing is replaced any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.fork_gain import FORK, MATCHED, ForkNote
from lerobot_roborecover.detection.forks.arms import ForkArm
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.trial import PolicyStateFactory, Trial
from lerobot_roborecover.logs.row import (
    ACTIONS_FOLDER,
    EvalProtocol,
    LoggedTrial,
    TrialRow,
    put_actions,
    trial_seed,
)
from lerobot_roborecover.policies.runner import (
    Act,
    Decision,
    PolicyError,
    PolicyRunner,
    Rollback,
    decision_of,
)
from lerobot_roborecover.scenario import Scenario, Start, TrialStart
from lerobot_roborecover.workers.messages import EpisodeSpec

SAME_ACTION = 1e-4
"""How far an action may be from the logged one where the policy is led through a trial: what a batch of
another size changes (docs/evaluate.md)."""
OWN, ANOTHER = "own", "another"
"""Random streams of continuations that check (`ForkNote.stream`)."""


@dataclass(frozen=True)
class Fork:
    """One continuation of a logged trial."""

    scenario: Scenario
    parent: LoggedTrial
    step: int
    """New steps of the parent before it."""
    arm: ForkArm
    repeat: int = 0
    on: str = MATCHED
    """Which random stream (`ForkNote.stream`)."""

    @property
    def stream(self) -> int | None:
        """Seed of the new stream; the same for all arms. None where the parent's goes on."""
        if self.on == OWN:
            return None
        row = self.parent.row
        repeat = self.repeat if self.on == MATCHED else -1
        return trial_seed(row.run_seed, f"{row.scenario_id}/{row.trial}/{self.step}", repeat)

    def note(self) -> ForkNote:
        """What its row says of it."""
        row = self.parent.row
        return ForkNote(row.config_hash, row.actions_sha256, self.step, self.arm.label, self.repeat, self.on)

    def protocol(self, shared: EvalProtocol) -> EvalProtocol:
        """That of its trial.

        Args:
            shared: what all forks of the arm hold fixed.
        """
        row = self.parent.row
        options = {**shared.options, FORK: self.note().as_json()}
        return replace(
            shared, start=row.start, rewind_steps=row.rewind_steps, run_seed=row.run_seed, options=options
        )


class ForkTrial(Trial):
    """A fork's trial; steps count from its parent's handoff, so that S limits all arms alike.

    Args:
        fork: which.
        protocol: the fork's.
        options: of `Trial`.
    """

    def __init__(self, fork: Fork, protocol: EvalProtocol, **options: Any):
        super().__init__(fork.scenario, fork.parent.row.trial, protocol, **options)
        self._fork = fork
        if not fork.arm.teacher_forced:
            self.steps = fork.step
            self._executed += [np.array(action) for action in fork.parent.actions[: fork.step]]

    def begin(self, record_video: bool = False) -> EpisodeSpec:
        """What a simulator needs to rebuild the fork's state."""
        spec = super().begin(record_video)
        fork, row = self._fork, self._fork.parent.row
        if fork.arm.teacher_forced:
            return spec
        kept = max(fork.step - fork.arm.back, 0)
        undone = fork.step - kept
        target = row.handoff_step
        if undone < fork.arm.back:  # into the prefix, as Reversion goes
            target = max(target - (fork.arm.back - undone), self.scenario.reset.settle_steps)
            back = len(self.scenario.prefix) - target
            spec = replace(spec, start=Start.REVERSION.value, rewind_steps=back)
        if fork.arm.back:
            distance = undone + row.handoff_step - target
            entry = {"asked": fork.arm.back, "distance": distance, "undone": undone}
            self._record.add({"kind": "rollback", "step": fork.step, "by": "fork", **entry})
        return replace(spec, played=fork.parent.actions[:kept], spent=fork.step)

    def open_history(self, host: PolicyStateFactory) -> Any:
        """The parent's, to be led to the fork; or a fresh one."""
        stream = self._fork.stream
        if not self._fork.arm.teacher_forced:
            return host.start(stream)
        assert isinstance(host, TeacherForcedRunner), (
            "the policy that continues is led through its parent's trial"
        )
        return host.lead(self.seed, self._fork.step, stream)

    def on_actions(self, decision: Decision, *, seconds: float) -> Act | Rollback | None:
        """As `Trial.on_actions`. Before the fork the logged actions replace the policy's equal ones."""
        fork = self._fork
        decision = decision_of(decision)
        if fork.arm.teacher_forced and self.steps < fork.step and isinstance(decision, Act):
            actions = decision.actions
            logged = fork.parent.actions[self.steps : self.steps + len(actions)]
            own = actions[: len(logged)]
            # `not`: also where one is no number
            if own.shape != logged.shape or not np.abs(own - logged).max() <= SAME_ACTION:
                self.on_policy_error(_other_actions(fork, self.steps, own, logged), seconds=seconds)
                return None
            # What is left of a chunk beyond the fork's step was in the policy's queue then.
            rest = actions[len(logged) :]
            decision = replace(decision, actions=np.concatenate([logged, rest]) if len(rest) else logged)
        return super().on_actions(decision, seconds=seconds)


def _other_actions(fork: Fork, step: int, own: np.ndarray, logged: np.ndarray) -> str:
    gap = f"{np.abs(own - logged).max():.2g}" if own.shape == logged.shape else "of another shape"
    row = fork.parent.row
    return (
        f"led through the logged trial, the policy's actions from step {step} on are not the logged ones "
        f"(largest difference {gap}; the limit is {SAME_ACTION:g}), so what it remembered at step "
        f"{fork.step} cannot be rebuilt. The trial's noise was drawn {row.noise}, in "
        f"batches of up to {row.batch_size}: record trials one at a time (--runner.max_batch=1), on this "
        "machine"
    )


@dataclass(eq=False)
class ForcedState:
    """History of a trial that is led to its fork."""

    inner: Any
    """The policy's."""
    left: int
    """Steps of the parent that are still to be executed."""
    stream: int | None
    """Seed of the stream that begins then; None where there is none, or it has begun."""


class TeacherForcedRunner:
    """A policy's host whose trials begin as logged ones did, and get a new random stream at the fork.

    Args:
        host: the policy's; needs `reseed` where there are new streams.
    """

    def __init__(self, host: PolicyRunner):
        self._host = host
        self.batched = host.batched

    @property
    def max_batch(self) -> int:
        return self._host.max_batch

    def noise(self, seed: int | None) -> str:
        return self._host.noise(seed)

    def start(self, seed: int | None) -> ForcedState:
        """A trial that is not led anywhere."""
        return self.lead(seed, 0, None)

    def lead(self, seed: int | None, steps: int, stream: int | None) -> ForcedState:
        """A trial that begins with the parent's seed.

        Args:
            seed: the parent's.
            steps: of the parent before the fork.
            stream: seed of what is drawn from then on; None goes on with the parent's.
        """
        return ForcedState(self._host.start(seed), steps, stream)

    def finish(self, history: ForcedState) -> None:
        self._host.finish(history.inner)

    def act(
        self, observations: Sequence, instructions: Sequence[str], histories: Sequence[ForcedState]
    ) -> Sequence[Decision | PolicyError]:
        for history in histories:
            if history.left <= 0 and history.stream is not None:
                reseed: Any = getattr(self._host, "reseed")  # noqa: B009 - not every host has it
                reseed(history.inner, history.stream)
                history.stream = None
        decisions = self._host.act(observations, instructions, [h.inner for h in histories])
        for history, decision in zip(histories, decisions, strict=True):
            if not isinstance(decision, PolicyError) and isinstance(act := decision_of(decision), Act):
                history.left -= len(act.actions)
        return decisions


@dataclass
class ForkRun(EvalSession):
    """A run of one arm's forks: unit k of a scenario is the k-th of `forks`."""

    forks: Sequence[Fork] = ()

    def keys(self, trials: Sequence[tuple[TrialStart, int]]) -> list[tuple]:
        """What the log knows the forks by."""
        return [self.trial(scenario, k).key for scenario, k in trials]

    def trial(self, scenario: TrialStart, index: int, protocol: EvalProtocol | None = None) -> Trial:
        """A fork's trial, not begun."""
        fork = self.forks[index]
        return ForkTrial(
            fork,
            fork.protocol(protocol or self.protocol),
            action_width=self.action_width(scenario),
            handoff_check=self.handoff_check,
        )

    def reuse_logged_outcome(self, fork: Fork) -> TrialRow:
        """The row of a continuation that is the rest of the logged trial, on disk with its actions, as it
        would be if the policy, which is deterministic, had run again."""
        protocol, log, row = fork.protocol(self.protocol), self.require_log(), fork.parent.row
        extent = self.extent
        row = replace(
            row,
            options=dict(protocol.options),
            config_hash=protocol.config_hash(),
            run_scenarios=extent.scenarios if extent else None,
            run_trials=extent.trials if extent else None,
            shard=extent.shard if extent else "",
        )
        put_actions(log.path.with_name(ACTIONS_FOLDER), fork.parent.actions, row)
        log.append(row)
        return row
