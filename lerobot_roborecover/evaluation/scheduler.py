"""Evaluation engine: keeps every slot busy, shares policies, and writes each result to the trial log at once.

The engine is one event loop. A slot goes through these states:

    idle -> its trial's states (`evaluation.trial`), from handing off to over -> idle

Waiting trials share one batch. A free slot starts the next trial at once. While a policy infers for some
slots, the simulators of the others step. The engine gets its slots and policies from outside (`launch`): from
this process and its children, or from a cluster (`ray_engine`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_roborecover.evaluation.batching import BatchTimer
from lerobot_roborecover.evaluation.first_trials import FirstTrials
from lerobot_roborecover.evaluation.session import EvalSession
from lerobot_roborecover.evaluation.trial import Trial, TrialState
from lerobot_roborecover.evaluation.videos import VideoRecorder, VideoWriter
from lerobot_roborecover.evaluation.work_items import WorkItem, WorkQueue, unfinished
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.policies.action_checks import count_problem
from lerobot_roborecover.policies.runner import (
    Act,
    PolicyError,
    PolicyUnavailableError,
    Replica,
    ReplicaHungError,
    ReplicaLostError,
)
from lerobot_roborecover.scenario import Outcome, TrialStart
from lerobot_roborecover.workers.messages import (
    ActResult,
    EpisodeStart,
    RollbackReply,
    SlotFailure,
    video_stride,
)
from lerobot_roborecover.workers.slots import MAX_ATTEMPTS, SimulatorWorker

MAX_CONSECUTIVE_FAILURES = 3
"""Simulator failures of one scenario in a row after which its other trials are not tried."""
_POLL_S = 0.5
"""Longest time between two calls of `stop`, seconds."""

type Waiter = Callable[[list[Any], float], Collection[Any]]
"""Waits for any of the handles, at most the given seconds; returns those that are ready."""
type Event = tuple[Replica | SimulatorWorker, Callable[[], None]]
"""A connection to wait for, and the action when it is ready."""


@dataclass(eq=False)
class ActiveTrial:
    """A trial that runs in a slot. Apart from `Trial`, which has no clock, process or file."""

    slot: SimulatorWorker
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
    def waiting(self) -> bool:
        """Whether the policy is to be asked about it."""
        return self.trial.state is TrialState.WAITING


class Engine:
    """Runs trials on slots.

    Args:
        run: protocol (with its run seed) and trial log.
        slots: slots, each with a simulator.
        replicas: copies of the policy.
        wait: waits for events of slots and replicas.
        batch_delay_s: minimum time that a waiting slot waits for others before the policy infers; longer
            where inferences are slow, see `batching`.
        on_row: called with every finished trial.
        videos: trials to record videos of, if any.
        queue_of: order of the trials.
        first: stops a run whose first trials all fail alike; None lets it go on.
        clock: returns seconds; slots' deadlines use the same clock.
    """

    def __init__(
        self,
        run: EvalSession,
        slots: Sequence[SimulatorWorker],
        replicas: Sequence[Replica],
        wait: Waiter,
        *,
        batch_delay_s: float = 0.01,
        on_row: Callable[[TrialRow], None] = lambda row: None,
        videos: VideoRecorder | None = None,
        queue_of: type[WorkQueue] = WorkQueue,
        first: FirstTrials | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._clock, self._queue_of = clock, queue_of
        self._run, self._replicas, self._wait = run, list(replicas), wait
        self._on_row, self._videos, self._first = on_row, videos, first
        self._slots = list(slots)
        self._active: dict[SimulatorWorker, ActiveTrial] = {}
        self._last: dict[SimulatorWorker, WorkItem] = {}
        self._asked: dict[Replica, tuple[list[ActiveTrial], float]] = {}
        self._timers = {r: BatchTimer(batch_delay_s) for r in self._replicas}
        self._failures: dict[str, int] = {}
        self._losses: dict[tuple[str, int], int] = {}
        self._queue = WorkQueue(())
        self._finished = 0
        self.reruns = 0
        """Trials that were restarted because a machine, the policy, or the connection to it was lost."""
        self._stop: Callable[[], bool] = lambda: False
        self.unrun: dict[tuple[str, int], str] = {}
        """Why trials were left for another run, by scenario and trial: the policy could not be reached, or an
        inference never ended."""

    def run(self, units: Sequence[WorkItem[TrialStart]], stop: Callable[[], bool] = lambda: False) -> int:
        """Runs all trials that the log does not hold yet.

        Args:
            units: trials to run.
            stop: called between events; True starts no new trial and drops the running ones.

        Returns:
            Number of trials finished.

        Raises:
            PolicyFailedError: the first trials failed alike.
        """
        self._queue = self._queue_of(unfinished(self._run, units))
        self._failures, self._losses = {}, {}
        self._finished, self._stop = 0, stop
        while not stop():
            self._fill()
            events = self._events()
            # Before a policy infers, slots that have replied join the batch or start their next trial.
            if self._collect(events, 0.0) or any(self._ask(r) for r in self._replicas):
                continue
            if not events:
                break
            self._collect(events, _POLL_S)
        for active in self._active_trials():
            if active.recording is not None:
                active.recording.drop()
        self._write_first()
        reasons = [r.gone for r in self._replicas if r.gone]
        if len(reasons) == len(self._replicas) and not stop():
            while (unit := self._queue.take(None)) is not None:
                self.unrun[unit.scenario.id, unit.trial] = reasons[0]
        return self._finished

    def _active_trials(self) -> list[ActiveTrial]:
        """The trials under way, in the order of their slots."""
        return [self._active[s] for s in self._slots if s in self._active]

    def _trials_of(self, replica: Replica) -> list[ActiveTrial]:
        return [s for s in self._active_trials() if s.replica is replica]

    # --- events

    def _fill(self) -> None:
        """Gives the next units to the slots without one."""
        for slot in self._slots:
            if slot in self._active or slot.starting:
                continue
            replica = self._least_busy()
            if replica is None:
                return
            unit = self._queue.take(self._last.get(slot), [s.unit.task for s in self._active_trials()])
            if unit is None:
                return
            self._start(slot, unit, replica)

    def _least_busy(self) -> Replica | None:
        users = [s.replica for s in self._active_trials()]
        able = (r for r in self._replicas if not (r.starting or r.gone))
        return min(able, key=users.count, default=None)

    def _start(self, slot: SimulatorWorker, unit: WorkItem[TrialStart], replica: Replica) -> None:
        trial = self._run.trial(unit.scenario, unit.trial)
        self._last[slot] = unit
        self._active[slot] = ActiveTrial(slot, unit, trial, replica, trial.open_history(replica.host))
        record_video = self._videos is not None and self._videos.wants(unit)
        slot.send("reset", trial.begin(record_video))

    def _ask(self, replica: Replica) -> bool:
        """Sends a free replica the trials that wait for it, unless others are about to join the batch."""
        at = self._ask_at(replica)
        if at is None or self._clock() < at:
            return False
        waiting = [s for s in self._trials_of(replica) if s.waiting]
        asking = sorted(waiting, key=lambda s: s.waiting_since)[: replica.host.max_batch]
        self._asked[replica] = asking, self._clock()
        replica.submit(
            [s.trial.ask() for s in asking],
            [s.unit.scenario.task.instruction for s in asking],
            [s.history for s in asking],
        )
        return True

    def _ask_at(self, replica: Replica) -> float | None:
        """Returns when to send a batch to a replica; None where no trial waits for it, or it is busy."""
        if replica.starting or replica in self._asked:
            return None
        mine = self._trials_of(replica)
        waiting = [s.waiting_since for s in mine if s.waiting]
        if not waiting:
            return None
        acting = [s.answered_at for s in mine if s.trial.in_simulator and s.answered_at is not None]
        handing_off = sum(s.trial.in_simulator and s.answered_at is None for s in mine)
        return self._timers[replica].ask_at(waiting, acting, handing_off, replica.host.max_batch)

    def _events(self) -> list[Event]:
        """What can happen next."""
        events: list[Event] = [(r, lambda r=r: self._answered(r)) for r in self._asked]
        working = [s for s in self._active_trials() if s.trial.in_simulator]
        events += [(s.slot, lambda s=s: self._replied(s)) for s in working]
        if len(self._queue):
            parties = [*self._replicas, *self._slots]
            events += [(p, p.poll_startup) for p in parties if p.starting]
        return events

    def _collect(self, events: list[Event], timeout_s: float) -> bool:
        """Handles the events that are there, or come until the first of them, a deadline, or the end of the
        batch delay.

        Args:
            events: what may happen.
            timeout_s: how long to wait at most.

        Returns:
            Whether anything happened.
        """
        inline = [e for e in events if e[0].ready is True]
        others = [e for e in events if e[0].ready is not True]
        arrived = self._arrived(others, 0.0 if inline else timeout_s) if others else []
        for _, act in arrived or inline:  # an inference in this process blocks all slots: replies come first
            act()
        return bool(arrived or inline)

    def _arrived(self, events: list[Event], timeout_s: float) -> list[Event]:
        now, deadlines = self._clock(), [getattr(party, "deadline", float("inf")) for party, _ in events]
        timeout_s = min(timeout_s, min(deadlines) - now)
        for replica in self._replicas:
            if (at := self._ask_at(replica)) is not None:
                timeout_s = min(timeout_s, at - now)
        ready = set(map(id, self._wait([p.ready for p, _ in events], max(timeout_s, 0.0))))
        now = self._clock()
        return [e for e, at in zip(events, deadlines, strict=True) if id(e[0].ready) in ready or at <= now]

    def _answered(self, replica: Replica) -> None:
        asked, began = self._asked.pop(replica)
        try:
            answers = replica.result(self._stop)
        except ReplicaLostError as err:
            if isinstance(err, ReplicaHungError):
                self._write_first()
                for active in asked:
                    active.trial.on_policy_error(err, seconds=self._clock() - began)
                    active.replica = None
                    self._finish(active)
            for active in self._trials_of(replica):
                active.replica = None
                if not active.trial.in_simulator:  # one that works is given up when its slot has replied
                    self._lost(active, str(err))
            return
        if answers is None:
            return
        if problem := count_problem(len(answers), len(asked)):
            answers = [PolicyError(problem)] * len(asked)
        seconds = self._clock() - began
        self._timers[replica].inferred(len(asked), seconds)
        for active, answer in zip(asked, answers, strict=True):
            trial, slot = active.trial, active.slot
            if isinstance(answer, PolicyUnavailableError):
                self._away(active, str(answer))
                continue
            if isinstance(answer, PolicyError):
                trial.on_policy_error(answer, seconds=seconds)
            else:
                move = trial.on_actions(answer, seconds=seconds)
                active.answered_at, active.answered_with = self._clock(), len(asked)
                if isinstance(move, Act):
                    slot.send("act", move.actions)
                elif move is not None:
                    slot.send("rollback", move.steps)
            if trial.over:
                self._finish(active)

    def _replied(self, active: ActiveTrial) -> None:
        reply = active.slot.receive()
        active.waiting_since = self._clock()
        if active.replica is None:
            self._lost(active, "the policy's process was lost")
            return
        if isinstance(reply, SlotFailure) and reply.kind == "lost":
            self._lost(active, reply.message)
            return
        if isinstance(reply, ActResult) and not reply.over:
            self._timers[active.replica].simulated(active.answered_with, reply.seconds)
        active.trial.on_reply(reply)
        if self._videos is not None and isinstance(reply, EpisodeStart) and reply.frame is not None:
            fps = reply.hz / video_stride(reply.hz)
            active.recording = self._videos.begin(active.unit, reply.frame, fps)
        elif active.recording is not None and isinstance(reply, ActResult):
            active.recording.add(reply.frames)
        elif active.recording is not None and isinstance(reply, RollbackReply) and reply.frame is not None:
            active.recording.add((reply.frame,))
        if active.trial.over:
            self._finish(active)

    # --- ends

    def _lost(self, active: ActiveTrial, reason: str) -> None:
        """The trial's machine is gone: it is run again from its start, elsewhere."""
        if self._lost_again(active):
            active.trial.fail(Outcome.SIM_ERROR, f"lost {MAX_ATTEMPTS} times, last: {reason}")
            self._finish(active)
            return
        self._run_again(active)

    def _away(self, active: ActiveTrial, reason: str) -> None:
        """Handles a policy that could not be reached: the trial is run again from its start.

        After `MAX_ATTEMPTS` losses the trial is left without a row, for a later run.
        """
        unit = active.unit
        if self._lost_again(active):
            self.unrun[unit.scenario.id, unit.trial] = reason
            self._leave(active)
        else:
            self._run_again(active)

    def _lost_again(self, active: ActiveTrial) -> bool:
        """Counts a loss; whether it was one too many."""
        key = (active.unit.scenario.id, active.unit.trial)
        self._losses[key] = self._losses.get(key, 0) + 1
        return self._losses[key] >= MAX_ATTEMPTS

    def _run_again(self, active: ActiveTrial) -> None:
        self.reruns += 1
        self._queue.put_back(active.unit)
        self._leave(active)

    def _finish(self, active: ActiveTrial) -> None:
        unit, trial = active.unit, active.trial
        outcome = trial.verdict()
        if self._videos is not None and active.recording is not None:
            self._videos.finish(active.recording, unit, outcome)
            active.recording = None
        self._record(trial, active.replica or self._replicas[0])
        self._leave(active)
        broke = outcome in (Outcome.SIM_ERROR, Outcome.TIMEOUT)
        count = self._failures[unit.scenario.id] = self._failures.get(unit.scenario.id, 0) + 1 if broke else 0
        if count >= MAX_CONSECUTIVE_FAILURES:
            for other in self._queue.drop(unit.scenario.id):
                parked = self._run.trial(other.scenario, other.trial)
                text = f"not tried: the scenario failed {count} times in a row, last {trial.reason}"
                parked.fail(outcome, text)
                self._record(parked, self._replicas[0])

    def _leave(self, active: ActiveTrial) -> None:
        if active.replica is not None:
            active.replica.host.finish(active.history)
        if active.recording is not None:
            active.recording.drop()
        del self._active[active.slot]

    def _write_first(self) -> None:
        """Writes the rows that were held back, and holds back no more."""
        first, self._first = self._first, None
        for trial, replica in first.release() if first is not None else ():
            self._record(trial, replica)

    def _record(self, trial: Trial, replica: Replica) -> None:
        if self._first is not None and self._first.hold(trial, replica):
            return
        self._write_first()
        host, seed = replica.host, self._run.protocol.run_seed
        batch_size = host.max_batch if host.batched else 1
        row = self._run.record(trial, noise=host.noise(seed), batch_size=batch_size)
        self._finished += 1
        self._on_row(row)
