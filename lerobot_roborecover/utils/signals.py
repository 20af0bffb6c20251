"""SIGTERM and SIGHUP end a process in good order, as Ctrl-C does.

A scheduler, `docker stop` and a closed terminal send them. By default they end a process at once: trials
under way leave no trace, and temporary folders stay.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""What asks a process to stop."""

type Handler = Callable[[int, FrameType | None], Any] | int | None


class Terminated(KeyboardInterrupt):
    """A stop signal other than Ctrl-C's.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.number = number


def status_of(interrupt: KeyboardInterrupt) -> int:
    """Returns the exit status of an interrupted command, which a shell reports for the signal."""
    return exit_status(interrupt.number if isinstance(interrupt, Terminated) else signal.SIGINT)


def exit_status(number: int) -> int:
    """Returns what a shell reports of a program that a signal ended."""
    return 128 + number


def raise_terminated(number: int, _frame: FrameType | None = None) -> None:
    raise Terminated(number)


@contextmanager
def stop_signals_raise() -> Generator[None]:
    """Has SIGTERM and SIGHUP raise `Terminated` in the block, unless they are ignored, as under nohup."""
    numbers = [n for n in (signal.SIGTERM, signal.SIGHUP) if _main_thread() and _is_default(n)]
    before = handle(numbers, raise_terminated)
    try:
        yield
    finally:
        put_back(before)


def handle(numbers: Iterable[int], handler: Handler) -> dict[int, Handler]:
    """Sets a handler for signals, except for SIGTERM and SIGHUP where they are ignored.

    Ctrl-C is ignored in every background job of a shell script, so that says nothing of what the user wants.

    Returns:
        The handlers from before, for `put_back`.
    """
    taken = [n for n in numbers if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]
    return {n: signal.signal(n, handler) for n in taken}


def put_back(handlers: dict[int, Handler]) -> None:
    """Sets handlers again that `handle` has replaced."""
    for number, handler in handlers.items():
        signal.signal(number, handler)


def _main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_default(number: int) -> bool:
    return signal.getsignal(number) is signal.SIG_DFL


class StopCondition:
    """Says when to stop: after a time limit, or at the first Ctrl-C, SIGTERM or SIGHUP. A second one of the
    same kind ends the process at once.

    Args:
        limit_s: seconds from now; 0 for none.
    """

    def __init__(self, limit_s: float):
        self._deadline = time.monotonic() + limit_s if limit_s else float("inf")
        self.reason = ""
        self.status = 0
        """Exit status of a run that stopped before its end."""
        self._before = handle(STOP_SIGNALS, self._interrupt)

    def _interrupt(self, number: int, _frame: object) -> None:
        self.reason, self.status = "interrupted", exit_status(number)
        put_back({number: self._before.pop(number)})

    def __call__(self) -> bool:
        """Whether to stop; `reason` then says why."""
        if not self.reason and time.monotonic() >= self._deadline:
            self.reason = "time limit reached"
        return bool(self.reason)

    def restore(self) -> None:
        """Puts the caller's own signal handlers back."""
        put_back(self._before)
