"""The engine: every slot busy, policies shared, results in the trial log as they come.

One loop over events. A seat (a slot and the trial it runs) goes round:

    idle -> its trial's states (`trials.trial`), from handing off to over -> idle

Whoever waits is asked about together; a seat whose trial is over takes the next unit at once. While a policy
infers for some seats the simulators of the others work. Where slots and policies live is the business of the
parts the engine is given: this process and its children (`local`), or a cluster (`ray_engine`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any

from lerobot_roborecover.env.directives import split
from lerobot_roborecover.env.run import Run
from lerobot_roborecover.env.trial import Act, Trial
from lerobot_roborecover.env.trial_log import TrialRow, trial_key
from lerobot_roborecover.policies.host import PolicyError, Replica, ReplicaLostError
from lerobot_roborecover.scenario import Outcome, Scenario
from lerobot_roborecover.trials.seat import Seat
from lerobot_roborecover.trials.units import Unit, UnitQueue
from lerobot_roborecover.trials.videos import VideoKeeper
from lerobot_roborecover.workers.messages import ActResult, EpisodeStart, RollbackResult, SlotFailure

PARK_AFTER = 3
"""Simulator failures of one scenario in a row after which its other trials are not tried; also how often a
trial may be lost with the machine it ran on."""
PATIENCE = 0.5
"""How long a waiting slot waits for company, in inferences. Where an inference takes as long for many as for
few, a batch that begins before its company has come costs the company a whole inference."""
_MOST_PATIENT_S = 0.25
_POLL_S = 0.5
"""How often `stop` is asked at least."""

type Waiter = Callable[[list[Any], float], Collection[Any]]
"""Waits for any of some handles, at most so many seconds; those that are ready."""


class Engine:
    """Runs units on slots.

    Args:
        run: protocol (with its run seed), trial log.
        slots: where simulators live: `send`, `receive`, `ready`, `deadline`, and `opening` and `opened` as
            `host.Replica` has them.
        replicas: the policies.
        wait: how to wait for slots and replicas.
        batch_delay_s: how long a waiting slot may wait for company before the policy is asked, at least;
            where inferences are slow it is longer, see `PATIENCE`.
        on_row: called with every finished trial.
        videos: which trials to film, if any.
        queue_of: in which order units are handed out.
        clock: seconds, the one that slots' deadlines are on.
    """

    def __init__(
        self,
        run: Run,
        slots: Sequence[Any],
        replicas: Sequence[Replica],
        wait: Waiter,
        *,
        batch_delay_s: float = 0.01,
        on_row: Callable[[TrialRow], None] = lambda row: None,
        videos: VideoKeeper | None = None,
        queue_of: type[UnitQueue] = UnitQueue,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._clock, self._queue_of = clock, queue_of
        self._run, self._replicas, self._wait = run, list(replicas), wait
        self._delay_s, self._on_row, self._videos = batch_delay_s, on_row, videos
        self._seats = [Seat(slot) for slot in slots]
        self._asked: dict[Replica, tuple[list[Seat], float]] = {}
        self._inference_s = {r: deque[float](maxlen=8) for r in self._replicas}
        self._failures: dict[str, int] = {}
        self._losses: dict[tuple[str, int], int] = {}
        self._queue = UnitQueue(())
        self._finished = 0
        self.reruns = 0
        """Trials that were begun again because a machine was lost."""

    def run(self, units: list[Unit], stop: Callable[[], bool] = lambda: False) -> int:
        """Runs all units that the log does not hold yet.

        Args:
            units: what to run.
            stop: asked between events; True starts no new trial and drops those under way.

        Returns:
            Number of trials finished.
        """
        self._queue = self._queue_of(unfinished(self._run, units))
        self._finished = 0
        while not stop():
            self._fill()
            events = self._events()
            # Whoever has replied meanwhile joins the batch, or takes its next unit, before a policy is asked.
            if self._collect(events, 0.0) or any(self._ask(r) for r in self._replicas):
                continue
            if not events:
                break
            self._collect(events, _POLL_S)
        for seat in self._seats:
            if seat.recording is not None:
                seat.recording.drop()
        return self._finished

    # --- events

    def _fill(self) -> None:
        """Gives the next units to the seats without one."""
        for seat in self._seats:
            while seat.trial is None and not seat.slot.opening and len(self._queue):
                replica = self._least_busy()
                if replica is None:
                    return
                self._start(seat, replica)

    def _least_busy(self) -> Replica | None:
        users = [s.replica for s in self._seats]
        return min((r for r in self._replicas if not r.opening), key=users.count, default=None)

    def _start(self, seat: Seat, replica: Replica) -> None:
        unit = self._queue.take(seat.last, [s.unit.task for s in self._seats if s.unit is not None])
        seat.unit = seat.last = unit
        seat.trial = self._run.trial(unit.scenario, unit.trial)
        seat.replica = replica
        seat.history = replica.host.start(seat.trial.seed)
        filmed = self._videos is not None and self._videos.wants(unit)
        seat.slot.send("reset", seat.trial.begin(filmed))

    def _ask(self, replica: Replica) -> bool:
        """Asks a free replica about the seats that wait for it, unless more company is to be expected."""
        if replica.opening or replica in self._asked:
            return False
        mine = [s for s in self._seats if s.replica is replica]
        waiting = [s for s in mine if s.waiting]
        if not waiting:
            return False
        limit = replica.host.max_batch
        company = any(s.working for s in mine)
        enough = len(waiting) >= min(limit, max(len(mine) // 2, 1))
        overdue = self._clock() - min(s.waiting_since for s in waiting) >= self._delay(replica)
        if company and not enough and not overdue:
            return False
        seats = sorted(waiting, key=lambda s: s.waiting_since)[:limit]
        self._asked[replica] = seats, self._clock()
        replica.ask(
            [s.trial.ask() for s in seats],
            [s.unit.scenario.task.instruction for s in seats],
            [s.history for s in seats],
        )
        return True

    def _delay(self, replica: Replica) -> float:
        """How long its slots wait for company."""
        # The shortest of the last inferences: the first ones compile.
        usual_s = min(self._inference_s[replica], default=0.0)
        return max(self._delay_s, min(PATIENCE * usual_s, _MOST_PATIENT_S))

    def _events(self) -> list[tuple[Any, Callable[[], None]]]:
        """What can happen next: whom to wait for, and what to do then."""
        events: list[tuple[Any, Callable[[], None]]] = []
        events += [(r, lambda r=r: self._answered(r)) for r in self._asked]
        events += [(s.slot, lambda s=s: self._replied(s)) for s in self._seats if s.working]
        if len(self._queue):
            parties = [*self._replicas, *(s.slot for s in self._seats)]
            events += [(p, p.opened) for p in parties if p.opening]
        return events

    def _collect(self, events: list[tuple[Any, Callable[[], None]]], timeout_s: float) -> bool:
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
        arrived = []
        if others:
            arrived = self._arrived(others, 0.0 if inline else timeout_s)
        for _, act in arrived or inline:  # an inference in this process holds everyone up: replies come first
            act()
        return bool(arrived or inline)

    def _arrived(
        self, events: list[tuple[Any, Callable[[], None]]], timeout_s: float
    ) -> list[tuple[Any, Callable[[], None]]]:
        now = self._clock()
        deadline = min(getattr(party, "deadline", float("inf")) for party, _ in events)
        timeout_s = min(timeout_s, deadline - now)
        for seat in self._seats:
            if seat.waiting and seat.replica is not None and seat.replica not in self._asked:
                timeout_s = min(timeout_s, self._delay(seat.replica) - (now - seat.waiting_since))
        ready = set(map(id, self._wait([p.ready for p, _ in events], max(timeout_s, 0.0))))
        now = self._clock()
        return [
            (party, act)
            for party, act in events
            if id(party.ready) in ready or getattr(party, "deadline", float("inf")) <= now
        ]

    def _answered(self, replica: Replica) -> None:
        seats, began = self._asked.pop(replica)
        try:
            chunks = replica.answer()
        except ReplicaLostError as err:
            for seat in self._seats:
                if seat.replica is replica:
                    seat.replica = None
                    if not seat.working:  # one that works is given up when its slot has replied
                        self._lost(seat, str(err))
            return
        seconds = self._clock() - began
        self._inference_s[replica].append(seconds)
        for seat, chunk in zip(seats, chunks, strict=True):
            if isinstance(chunk, PolicyError):
                seat.trial.refused(chunk, seconds=seconds)
            else:
                actions, directives = split(chunk, self._run.action_width(seat.unit.scenario))
                move = seat.trial.decide(actions, directives, seconds=seconds)
                if move is not None:
                    act = isinstance(move, Act)
                    seat.slot.send(*(("act", move.actions) if act else ("rollback", move.steps)))
                    continue
            self._finish(seat)

    def _replied(self, seat: Seat) -> None:
        reply = seat.slot.receive()
        seat.waiting_since = self._clock()
        if seat.replica is None:
            self._lost(seat, "the policy's process was lost")
            return
        if isinstance(reply, SlotFailure) and reply.kind == "lost":
            self._lost(seat, reply.message)
            return
        seat.trial.take(reply)
        if isinstance(reply, EpisodeStart) and reply.frame is not None:
            seat.recording = self._videos.begin(seat.unit, reply.frame, reply.hz)
        elif seat.recording is not None and isinstance(reply, ActResult):
            seat.recording.add(reply.frames)
        elif seat.recording is not None and isinstance(reply, RollbackResult):
            seat.recording.add((reply.frame,))
        if seat.trial.over:
            self._finish(seat)

    # --- ends

    def _lost(self, seat: Seat, reason: str) -> None:
        """The trial's machine is gone: it is run again from its start, elsewhere."""
        key = (seat.unit.scenario.id, seat.unit.trial)
        self._losses[key] = self._losses.get(key, 0) + 1
        if self._losses[key] >= PARK_AFTER:
            seat.trial.fail(Outcome.SIM_ERROR, f"lost {PARK_AFTER} times, last: {reason}")
            self._finish(seat)
            return
        self.reruns += 1
        self._queue.put_back(seat.unit)
        self._leave(seat)

    def _finish(self, seat: Seat) -> None:
        unit, trial = seat.unit, seat.trial
        if seat.recording is not None:
            self._videos.finish(seat.recording, unit, trial.outcome)
            seat.recording = None
        self._record(trial, seat.replica or self._replicas[0])
        self._leave(seat)
        broke = trial.outcome in (Outcome.SIM_ERROR, Outcome.TIMEOUT)
        count = self._failures[unit.scenario.id] = self._failures.get(unit.scenario.id, 0) + 1 if broke else 0
        if count >= PARK_AFTER:
            for other in self._queue.drop(unit.scenario.id):
                parked = self._run.trial(other.scenario, other.trial)
                text = f"not tried: the scenario failed {count} times in a row, last {trial.reason}"
                parked.fail(trial.outcome, text)
                self._record(parked, self._replicas[0])

    def _leave(self, seat: Seat) -> None:
        if seat.replica is not None:
            seat.replica.host.finish(seat.history)
        if seat.recording is not None:
            seat.recording.drop()
        seat.unit = seat.trial = seat.replica = seat.history = seat.recording = None

    def _record(self, trial: Trial, replica: Replica) -> None:
        host = replica.host
        noise = host.noise(self._run.protocol.run_seed)
        row = self._run.record(trial, noise=noise, batch_size=host.max_batch if host.batched else 1)
        self._finished += 1
        self._on_row(row)


def unfinished(run: Run, units: Sequence[Unit]) -> list[Unit]:
    """Units that the run's trial log does not hold yet."""
    if run.log is None:
        return list(units)
    hash_ = run.protocol.config_hash()
    keys = [trial_key(u.scenario.sha256(), u.scenario.id, hash_, u.trial) for u in units]
    return [u for u, key in zip(units, keys, strict=True) if run.log.find(key) is None]


def units_of(scenarios: Sequence[Scenario], trials: int) -> list[Unit]:
    """All trials of all scenarios."""
    return [Unit(s, k) for s in scenarios for k in range(trials)]
