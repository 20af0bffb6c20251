"""Slots run simulators: a worker slot in a process of its own, an inline slot in the caller's process.

A slot takes one command at a time: `send`, then `receive`. Between the two the caller may send to other
slots, so that the simulators of a batch run in parallel.
"""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Collection
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol, cast

from lerobot_roborecover.workers.messages import (
    Channel,
    Command,
    Reply,
    Server,
    SlotConfig,
    SlotFailure,
    make_memory,
)

MAX_ATTEMPTS = 3
"""Attempts of an item whose machine is lost; after these the item counts as the cause."""
_LOG_TAIL_BYTES = 600
_START_S = 60.0
"""Time a fresh worker may take to import its simulator, added to the watchdog's limit for its first
command."""


class Slot(Protocol):
    """Runs one trial at a time."""

    @property
    def starting(self) -> bool:
        """Whether it cannot be asked yet; `ready` then says when to call `poll_startup`."""

    def send(self, command: str, argument: object = None) -> None:
        """Starts a command."""

    def receive(self) -> Reply:
        """Its reply, or a `SlotFailure`. After a failure other than `raised` the slot has already been
        replaced."""

    def close(self) -> None:
        """Ends the slot."""


class SimulatorWorker(Slot, Protocol):
    """A slot in a process of its own, so that its caller need not wait: here, or on a cluster."""

    @property
    def ready(self) -> Any:
        """What `wait` waits on for the reply; True where it is there already."""

    @property
    def deadline(self) -> float:
        """When the command under way counts as hung, on the monotonic clock."""

    def poll_startup(self) -> None:
        """Finds out whether the opening has worked; it may have begun again."""

    def wait(self, handles: list[Any], timeout_s: float) -> Collection[Any]:
        """Those of the handles, of slots of this kind, that are ready, once any is or the time is up."""

    def end(self) -> None:
        """Ends the process at once, whatever it does; the next command starts another."""


type MakeSlot = Callable[[SlotConfig, float, int], Slot]
"""Makes a slot, given what it serves, its watchdog and its number in its pool."""


class InlineSlot:
    """Runs the simulator in this process: for debugging; nothing guards against one that hangs."""

    starting = False

    def __init__(self, config: SlotConfig):
        self._config = config
        self._server: Server | None = None
        self._pending: tuple[str, object] | None = None

    def send(self, command: str, argument: object = None) -> None:
        """Remembers the command; it runs in `receive`."""
        self._pending = (command, argument)

    def receive(self) -> Reply:
        assert self._pending is not None, "receive without send"
        command, argument = self._pending
        self._pending = None
        try:
            if self._server is None:
                self._server = self._config.make_server()
            return self._server.answer(command, argument)
        except Exception as err:
            traceback.print_exc()
            return SlotFailure("raised", f"{type(err).__name__}: {err}")

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None


class WorkerSlot:
    """Runs the simulator in a worker process, and replaces the process when it dies or hangs.

    Args:
        config: what the worker serves.
        timeout_s: longest any one command may take before the worker is taken for hung.
    """

    starting = False
    """A command can be sent at once: it waits in the socket until the worker has started."""
    wait = staticmethod(wait)

    def __init__(self, config: SlotConfig, timeout_s: float):
        self._config = config
        self._timeout_s = timeout_s
        self._start_s = _START_S if config.start_s is None else config.start_s
        self._process: subprocess.Popen | None = None
        self._channel: Channel | None = None
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the slot
        self._unsent: SlotFailure | None = None
        self.deadline = 0.0
        """When the command under way counts as hung, on the monotonic clock."""
        self._start()

    @property
    def ready(self) -> Connection | bool:
        """What `multiprocessing.connection.wait` can wait on for the reply; True where it is there
        already."""
        if self._unsent is not None:
            return True
        assert self._channel is not None
        return self._channel.connection

    def poll_startup(self) -> None:
        """Nothing to find out."""

    @property
    def pid(self) -> int:
        """Process id of the current worker."""
        assert self._process is not None
        return self._process.pid

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        environment = {
            # A simulator step is single-threaded work; a thread pool a worker fights the policy for the
            # cores.
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MUJOCO_GL": "egl",
            **os.environ,
            **self._config.environment,
        }
        # A package directory on sys.path through the caller's working directory must be found by the worker
        # as well.
        environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
        memory = make_memory()
        handed = [theirs.fileno(), *([] if memory is None else [memory])]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lerobot_roborecover.workers.worker", *map(str, handed)],
            pass_fds=handed,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={k: v for k, v in environment.items() if v is not None},
        )
        theirs.close()
        self._channel = Channel(Connection(ours.detach()), memory)
        if memory is not None:
            os.close(memory)
        self._channel.send(self._config)
        self._started = False

    def send(self, command: str, argument: object = None) -> None:
        """Sends a command to the worker; starts one where it was ended."""
        if self._channel is None:
            self._start()
        assert self._channel is not None
        self.deadline = time.monotonic() + self._timeout_s + (0.0 if self._started else self._start_s)
        try:
            self._channel.send(Command(command, argument))
        except (BrokenPipeError, ConnectionResetError):
            self._unsent = self._replace("died")

    def receive(self) -> Reply:
        """Waits for the reply, at most `timeout_s`."""
        if self._unsent is not None:
            failure, self._unsent = self._unsent, None
            return failure
        assert self._channel is not None
        try:
            left_s = max(self.deadline - time.monotonic(), 0.0)
            if not self._channel.connection.poll(left_s if left_s < math.inf else None):
                return self._replace("hung")
            reply = self._channel.receive()
            self._started = True
            return reply
        except (EOFError, ConnectionResetError):
            return self._replace("died")

    def _replace(self, kind: str) -> SlotFailure:
        """Ends a worker that died or hung, starts another, and says what happened."""
        assert self._process is not None
        if kind == "hung":
            what = f"the worker did not answer within {self._timeout_s:g} s and was replaced"
        else:
            try:
                code = self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                code = None
            cause = signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"
            what = f"the worker died ({cause}) and was replaced"
        self._stop()
        tail = self._log_tail()
        self._start()
        return SlotFailure(kind, f"{what}. Its last output: {tail}" if tail else what)

    def _log_tail(self) -> str:
        size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(size - _LOG_TAIL_BYTES, 0))
        tail = self._log.read().decode(errors="replace").strip()
        self._log.seek(0)
        self._log.truncate()
        return tail

    def end(self) -> None:
        """Ends the worker at once, whatever it does; the next command starts another."""
        self._stop()
        self._unsent = None

    def _stop(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def close(self) -> None:
        """Lets the worker finish its command and exit; kills it if it does not."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        if self._process is not None:
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        self._log.close()


class SlotPool:
    """The slots of a run, shared by all its scenarios and started when first needed.

    Args:
        config: what every slot serves.
        workers: processes of their own (True), or inline in this one.
        timeout_s: the watchdog of worker slots.
    """

    def __init__(self, config: SlotConfig, *, workers: bool, timeout_s: float):
        self._config, self._timeout_s = config, timeout_s
        self._slots: list[Slot] = []
        self._users = 0
        self._spaces: dict | None = None
        self._closers: list[Callable[[], object]] = []
        self._make: MakeSlot = lambda config, timeout_s, turn: (
            WorkerSlot(config, timeout_s) if workers else InlineSlot(config)
        )

    @property
    def config(self) -> SlotConfig:
        """What every slot serves."""
        return self._config

    @property
    def timeout_s(self) -> float:
        """The watchdog of worker slots."""
        return self._timeout_s

    def configure(self, **changes: Any) -> None:
        """Changes the configuration of slots that have not started yet."""
        self._config = replace(self._config, **changes)

    def make_with(self, make: MakeSlot) -> None:
        """Has slots that have not started yet made elsewhere."""
        self._make = make

    def on_close(self, closer: Callable[[], object]) -> None:
        """Has `closer` called once the last user is out, before those that were there already."""
        self._closers.append(closer)

    def acquire(self) -> None:
        """Counts a user in."""
        self._users += 1

    def release(self) -> None:
        """Counts a user out; the last one closes the slots."""
        self._users -= 1
        if self._users <= 0:
            self.close()

    def slots(self, count: int) -> list[Slot]:
        """The first `count` slots."""
        while len(self._slots) < count:
            self._slots.append(self._make(self._config, self._timeout_s, len(self._slots)))
        return self._slots[:count]

    def worker_slots(self, count: int) -> list[SimulatorWorker]:
        """`count` slots of a pool whose slots are processes of their own.

        Those that are there come first: one whose machine was lost finds no room on a cluster as long as the
        others keep theirs.
        """
        self.slots(count)
        made = [cast(SimulatorWorker, slot) for slot in self._slots if not isinstance(slot, InlineSlot)]
        return sorted(made, key=lambda slot: slot.starting)[:count]

    def ask(self, command: str) -> Reply:
        """A slot's reply to a command that has no argument."""
        self.slots(1)
        slot = min(self._slots, key=lambda each: each.starting)
        for _ in range(MAX_ATTEMPTS):
            slot.send(command)
            reply = slot.receive()
            if not (isinstance(reply, SlotFailure) and reply.kind == "lost"):
                break
        return reply

    def spaces(self) -> dict:
        """`observation_space` and `hz` of the simulator.

        Raises:
            RuntimeError: the simulator cannot be made.
        """
        if self._spaces is None:
            reply = self.ask("spaces")
            if not isinstance(reply, dict):
                why = reply.message if isinstance(reply, SlotFailure) else repr(reply)
                raise RuntimeError(f"no simulator could be made: {why}")
            self._spaces = reply
        return self._spaces

    def close(self) -> None:
        for slot in self._slots:
            slot.close()
        self._slots = []
        while self._closers:
            self._closers.pop()()
