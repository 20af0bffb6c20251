"""Keeps a policy that never answers from blocking the run.

Our loops ask the policy on a thread of its own (`PolicyThread`). A thread cannot be ended from outside. One
that does not come back is left behind: it is a daemon, so that Python does not wait for it, and a command
leaves at once where there is one (`exit_process`), since libraries may wait for their own threads, or crash
when they are unloaded under a running computation. Native code that blocks without releasing Python's lock
stops every thread; in a command, `faulthandler` then ends the process, which needs no lock.

In LeRobot's loop a `PolicyWatch` ends the evaluation. LeRobot asks the policy itself, in a thread that
nothing can end. The environment sees only that no action comes after an observation. Once that has lasted too
long:

1. The trials that wait get their rows, as under `roborecover eval`.
2. The main thread is interrupted as by Ctrl-C, so that LeRobot closes what it has opened.
3. If it does not come back from the policy for that either, the process ends.
"""

from __future__ import annotations

import contextlib
import contextvars
import faulthandler
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future, wait
from typing import Any

_POLL_S = 0.5
"""How often `stop` is asked while a call runs."""
_GRACE_S = 5.0
"""How long a call may go on after `stop`, or at the end of a run, before it is left behind."""
_LOCK_GRACE_S = 10.0
"""How long after a call's limit Python may run nothing at all before the process ends."""
_WATCH_POLL_S = 1.0
_INTERRUPT_S = 30.0
"""From the interruption by a `PolicyWatch` to the end of the process."""


def hang_reason(limit_s: float) -> str:
    """Returns what a trial's row says where the policy took too long.

    Args:
        limit_s: the watchdog's limit.
    """
    return (
        f"the policy did not answer within {limit_s:g} s. If it needs longer, for a first compilation say, "
        "raise --env.policy_watchdog_s"
    )


class CallTimeoutError(RuntimeError):
    """A call took longer than its limit."""


class CallStoppedError(RuntimeError):
    """The run is to stop, and the call under way did not end within the grace period."""


class PolicyThread:
    """Runs calls one after the other on a daemon thread.

    The thread has the context variables, and the CUDA device, of the thread that makes it.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self._device, self._overdue = _cuda_device(), False
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._work,), name="roborecover-policy", daemon=True
        )
        self._thread.start()

    def call[T](
        self,
        function: Callable[[], T],
        *,
        limit_s: float = float("inf"),
        stop: Callable[[], bool] = lambda: False,
    ) -> T:
        """Runs a function on the thread, and returns or raises what it does.

        Args:
            function: without arguments.
            limit_s: seconds that it may take.
            stop: asked meanwhile; True ends the wait after a grace period.

        Raises:
            CallTimeoutError: it took longer. The thread is still at it, and can run nothing else.
            CallStoppedError: `stop` said so, with the same effect.
        """
        future: Future[T] = Future()
        self._calls.put((future, function))
        ends, stops_at = time.monotonic() + limit_s, float("inf")
        with _end_of_the_process(limit_s):
            while not future.done():
                now = time.monotonic()
                if now >= min(ends, stops_at):
                    self._overdue = True
                    raise CallTimeoutError if now >= ends else CallStoppedError
                if stops_at == float("inf") and stop():
                    stops_at = now + _GRACE_S
                wait([future], min(_POLL_S, ends - now, stops_at - now))
        return future.result()

    def close(self) -> None:
        """Ends the thread once it is idle, and waits for that within the grace period, unless it had one."""
        self._calls.put(None)
        self._thread.join(0.0 if self._overdue else _GRACE_S)
        if self._thread.is_alive():
            _left_behind.append(self._thread)

    def _work(self) -> None:
        if self._device is not None:
            sys.modules["torch"].cuda.set_device(self._device)
        while (item := self._calls.get()) is not None:
            future, function = item
            try:
                value = function()
            except BaseException as err:  # whatever it is, it belongs to the caller
                future.set_exception(err)
            else:
                future.set_result(value)
            del item, future, function


_left_behind: list[threading.Thread] = []
_process_is_ours = False


def own_process() -> None:
    """Says that this process is a command of ours, which may be ended."""
    global _process_is_ours
    _process_is_ours = True


@contextlib.contextmanager
def _end_of_the_process(limit_s: float) -> Generator[None]:
    """Ends the process, with a traceback, where a limit passes and no Python code can run."""
    if not _process_is_ours or limit_s == float("inf"):
        yield
        return
    faulthandler.dump_traceback_later(limit_s + _LOCK_GRACE_S, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def exit_process(status: int) -> None:
    """Ends the process at once if a policy thread was left behind in it; otherwise returns.

    Args:
        status: the process's exit status.
    """
    if not any(thread.is_alive() for thread in _left_behind):
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # the reader is gone, or the stream is closed
            stream.flush()
    os._exit(status)


def _cuda_device() -> int | None:
    torch = sys.modules.get("torch")
    return torch.cuda.current_device() if torch is not None and torch.cuda.is_initialized() else None


class PolicyWatch:
    """A watchdog for the policy, in a daemon thread of its own.

    Args:
        limit_s: longest time from an observation to the next action.
        where: the trial log, for the message.
    """

    def __init__(self, limit_s: float, where: str):
        self._limit_s, self._where = limit_s, where
        self._lock = threading.Lock()
        self._waiting: tuple[float, Callable[[str], None]] | None = None
        self._closed = threading.Event()
        threading.Thread(target=self._work, name="roborecover-watchdog", daemon=True).start()

    def begin(self, on_hang: Callable[[str], None]) -> None:
        """Called when the policy has been given an observation.

        Args:
            on_hang: called from the watchdog's thread with the reason.
        """
        with self._lock:
            self._waiting = time.monotonic() + self._limit_s, on_hang

    def end(self) -> None:
        """Called when there is nothing to wait for, an action has come, say."""
        with self._lock:
            self._waiting = None

    def close(self) -> None:
        self._closed.set()

    def _work(self) -> None:
        while not self._closed.wait(min(_WATCH_POLL_S, self._limit_s)):
            with self._lock:  # an action that comes now waits until the process ends
                if self._waiting is not None and time.monotonic() >= self._waiting[0]:
                    self._waiting[1](hang_reason(self._limit_s))
                    break
        else:
            return
        print(
            f"{hang_reason(self._limit_s)}. The evaluation ends here. What has finished is in {self._where}; "
            "the same command with this trial log goes on",
            file=sys.stderr,
            flush=True,
        )
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        if not self._closed.wait(_INTERRUPT_S):
            os._exit(1)
