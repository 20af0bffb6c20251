"""The engine: every slot busy, policies shared, results in the trial log as they come.

One loop over events. A seat (a slot and the trial it runs) goes round:

    idle -> working (handing off) -> waiting -> asked -> working (executing a chunk) -> waiting ... -> idle

Whoever waits is asked about together; a seat whose trial ends takes the next unit at once. While a policy
infers for some seats the simulators of the others work. Where slots and policies live is the business of the
parts the engine is given: this process and its children (`local`), or a cluster (`ray_engine`).
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from lerobot_roborecover.env.directives import split
from lerobot_roborecover.env.episode import (
    ActResult,
    EpisodeSpec,
    EpisodeStart,
    RollbackResult,
    SlotFailure,
)
from lerobot_roborecover.env.intervention_record import InterventionRecord
from lerobot_roborecover.env.trial_log import TrialRow, make_row, trial_key, trial_seed
from lerobot_roborecover.env.vector_env import FAILURES, SOLVED_THERE, Run, action_problem
from lerobot_roborecover.evaluate.host import PolicyError, Replica, ReplicaLostError
from lerobot_roborecover.evaluate.seat import Seat
from lerobot_roborecover.evaluate.units import Unit, UnitQueue
from lerobot_roborecover.evaluate.videos import VideoKeeper
from lerobot_roborecover.scenario import Outcome, Scenario

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
        clock: Callable[[], float] = time.monotonic,
    ):
        self._clock = clock
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
        self._queue = UnitQueue(unfinished(self._run, units))
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
            while seat.unit is None and seat.state == "idle" and not seat.slot.opening and len(self._queue):
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
        protocol = self._run.protocol
        seat.replica = replica
        seat.history = replica.host.start(trial_seed(protocol.run_seed, unit.scenario.id, unit.trial))
        seat.observation, seat.handoff, seat.recording = None, None, None
        seat.steps, seat.sim_s, seat.policy_s = 0, 0.0, 0.0
        seat.actions, seat.record = hashlib.sha256(), InterventionRecord()
        filmed = self._videos is not None and self._videos.wants(unit)
        self._send(
            seat,
            "reset",
            EpisodeSpec(
                unit.scenario,
                protocol.start,
                protocol.rewind_for(unit.scenario),
                self._run.handoff_check,
                filmed,
                self._run.rollback_steps(unit.scenario),
            ),
        )

    def _ask(self, replica: Replica) -> bool:
        """Asks a free replica about the seats that wait for it, unless more company is to be expected."""
        if replica.opening or replica in self._asked:
            return False
        mine = [s for s in self._seats if s.replica is replica]
        waiting = [s for s in mine if s.state == "waiting"]
        if not waiting:
            return False
        limit = replica.host.max_batch
        company = any(s.state == "working" for s in mine)
        enough = len(waiting) >= min(limit, max(len(mine) // 2, 1))
        overdue = self._clock() - min(s.waiting_since for s in waiting) >= self._delay(replica)
        if company and not enough and not overdue:
            return False
        seats = sorted(waiting, key=lambda s: s.waiting_since)[:limit]
        for seat in seats:
            seat.state = "asked"
        self._asked[replica] = seats, self._clock()
        replica.ask(
            [s.observation for s in seats],
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
        events += [(s.slot, lambda s=s: self._replied(s)) for s in self._seats if s.state == "working"]
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
            if seat.state == "waiting" and seat.replica is not None and seat.replica not in self._asked:
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
                    if seat.state != "working":  # one that works is given up when its slot has replied
                        self._lost(seat, str(err))
            return
        seconds = self._clock() - began
        self._inference_s[replica].append(seconds)
        for seat, chunk in zip(seats, chunks, strict=True):
            seat.policy_s += seconds
            if isinstance(chunk, PolicyError):
                self._finish(seat, Outcome.POLICY_ERROR, f"at step {seat.steps}: {chunk}")
                continue
            chunk, seat.directives = split(chunk, self._run.action_width(seat.unit.scenario))
            if seat.directives is not None and seat.directives[0].rollback:
                seat.record.note(seat.directives[0], seat.steps)
                self._send(seat, "rollback", seat.directives[0].rollback)
                continue
            good = 0
            while good < len(chunk) and not self._problem(seat, chunk[good]):
                good += 1
            if not good:
                self._finish(seat, Outcome.POLICY_ERROR, self._problem(seat, chunk[0]))
            else:  # a bad action later in the chunk ends the trial when it comes up, if it does
                self._send(seat, "act", chunk[:good])
                seat.sent = chunk

    def _replied(self, seat: Seat) -> None:
        reply = seat.slot.receive()
        seat.state = "waiting"
        seat.waiting_since = self._clock()
        if seat.replica is None:
            self._lost(seat, "the policy's process was lost")
        elif isinstance(reply, SlotFailure) and reply.kind == "lost":
            self._lost(seat, reply.message)
        elif isinstance(reply, SlotFailure):
            where = f"at step {seat.steps}" if seat.handoff else "at the handoff"
            self._finish(seat, FAILURES[reply.kind], f"{where}: {reply.message}")
        elif isinstance(reply, EpisodeStart):
            seat.observation, seat.handoff = reply.observation, reply.handoff
            if reply.frame is not None:
                seat.recording = self._videos.begin(seat.unit, reply.frame, reply.hz)
            if reply.handoff.problem is not None:
                self._finish(seat, reply.handoff.problem, reply.handoff.reason)
        elif isinstance(reply, RollbackResult):
            self._went_back(seat, reply)
        else:
            assert isinstance(reply, ActResult)
            self._acted(seat, reply)

    def _acted(self, seat: Seat, reply: ActResult) -> None:
        seat.sim_s += reply.seconds
        for index, action in enumerate(seat.sent[: reply.steps]):
            seat.actions.update(np.ascontiguousarray(action).tobytes())
            if seat.directives is not None:
                seat.record.note(seat.directives[index], seat.steps + index)
                seat.record.acted(seat.directives[index])
        seat.steps += reply.steps
        seat.observation = reply.observation
        if seat.recording is not None:
            seat.recording.add(reply.frames)
        if reply.success:
            seat.record.solved()
        if reply.over:
            outcome, seat.steps = seat.record.verdict(seat.steps, seat.unit.scenario.task.horizon)
            self._finish(seat, outcome)
        elif reply.steps < len(seat.sent):
            problem = self._problem(seat, seat.sent[reply.steps])
            self._finish(seat, Outcome.POLICY_ERROR, problem)

    def _went_back(self, seat: Seat, reply: RollbackResult) -> None:
        seat.record.rolled_back(seat.directives[0].rollback, reply)
        seat.sim_s += reply.seconds
        seat.observation = reply.observation
        if seat.recording is not None:
            seat.recording.add((reply.frame,))
        if reply.solved:
            self._finish(seat, Outcome.SOLVED_BY_PREFIX, SOLVED_THERE)

    def _problem(self, seat: Seat, action: np.ndarray) -> str:
        scenario = seat.unit.scenario
        return action_problem(scenario, action, self._run.action_width(scenario))

    # --- ends

    def _send(self, seat: Seat, command: str, argument: Any) -> None:
        seat.slot.send(command, argument)
        seat.state = "working"

    def _lost(self, seat: Seat, reason: str) -> None:
        """The trial's machine is gone: it is run again from its start, elsewhere."""
        key = (seat.unit.scenario.id, seat.unit.trial)
        self._losses[key] = self._losses.get(key, 0) + 1
        if self._losses[key] >= PARK_AFTER:
            self._finish(seat, Outcome.SIM_ERROR, f"lost {PARK_AFTER} times, last: {reason}")
            return
        self.reruns += 1
        self._queue.put_back(seat.unit)
        self._leave(seat)

    def _finish(self, seat: Seat, outcome: Outcome, reason: str = "") -> None:
        unit = seat.unit
        if seat.recording is not None:
            self._videos.finish(seat.recording, unit, outcome)
            seat.recording = None
        self._log(unit, outcome, reason, seat)
        self._leave(seat)
        broke = outcome in (Outcome.SIM_ERROR, Outcome.TIMEOUT)
        count = self._failures[unit.scenario.id] = self._failures.get(unit.scenario.id, 0) + 1 if broke else 0
        if count >= PARK_AFTER:
            for other in self._queue.drop(unit.scenario.id):
                text = f"not tried: the scenario failed {count} times in a row, last {reason}"
                self._log(other, outcome, text, Seat(None))

    def _leave(self, seat: Seat) -> None:
        if seat.replica is not None:
            seat.replica.host.finish(seat.history)
        if seat.recording is not None:
            seat.recording.drop()
        seat.state, seat.unit, seat.replica = "idle", None, None
        seat.history, seat.observation, seat.recording = None, None, None

    def _log(self, unit: Unit, outcome: Outcome, reason: str, seat: Seat) -> None:
        host = seat.replica.host if seat.replica is not None else self._replicas[0].host
        row = make_row(
            unit.scenario,
            self._run.protocol,
            dataset=self._run.dataset,
            dataset_revision=self._run.dataset_revision,
            trial=unit.trial,
            noise=host.noise(self._run.protocol.run_seed),
            batch_size=host.max_batch if host.batched else 1,
            outcome=outcome,
            reason=reason,
            steps=seat.steps,
            handoff=seat.handoff,
            sim_s=seat.sim_s,
            policy_s=seat.policy_s,
            actions_sha256=seat.actions.hexdigest(),
            interventions=seat.record.entries(),
        )
        if self._run.log is not None:
            self._run.log.append(row)
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
