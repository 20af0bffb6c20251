"""Ends an evaluation by LeRobot's loop whose policy never answers.

LeRobot asks the policy itself, in a thread that nothing can end. The environment sees only that no action
comes after an observation. Once that has lasted too long:

1. The trials that wait get their rows, as under `roborecover eval`.
2. The main thread is interrupted as by Ctrl-C, so that LeRobot closes what it has opened.
3. If it does not come back from the policy for that either, the process ends.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable

_POLL_S = 1.0
_GRACE_S = 30.0
"""From the interruption to the end of the process."""


def hang_reason(limit_s: float) -> str:
    """Returns what a trial's row says where the policy took too long.

    Args:
        limit_s: the watchdog's limit.
    """
    return (
        f"the policy did not answer within {limit_s:g} s. If it needs longer, for a first compilation say, "
        "raise --env.policy_watchdog_s"
    )


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
        while not self._closed.wait(min(_POLL_S, self._limit_s)):
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
        if not self._closed.wait(_GRACE_S):
            os._exit(1)
