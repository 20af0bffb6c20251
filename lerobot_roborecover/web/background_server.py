"""Work in a process of its own that says lines, such as a server at its address."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, Self

from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.parent import end_with_parent

type Say = Callable[[str], None]

_END_S = 10.0
"""How long a process may take to end when it is told to."""


class BackgroundServer:
    """A process that does some work; it ends with this one, and at the end of a `with`.

    Args:
        name: for messages, such as "the annotation server".
        work: called there with the arguments and, last, something to say lines with.
        arguments: picklable.
    """

    def __init__(self, name: str, work: Callable[..., None], *arguments: Any):
        context = multiprocessing.get_context("spawn")
        self._name = name
        self._lines, its = context.Pipe(duplex=False)
        # Not a daemon: those may not start processes of their own, such as simulators.
        self._process = context.Process(target=_work, args=(os.getpid(), its, work, arguments))
        self._process.start()
        its.close()

    def fileno(self) -> int:
        """For `multiprocessing.connection.wait`: ready when there is a line, or the end."""
        return self._lines.fileno()

    def hear(self, until: float | None = None) -> str | None:
        """The next line, or None where the work is done.

        Args:
            until: value of `time.monotonic()` up to which to wait; None waits for as long as it takes.

        Raises:
            ScenarioError: the work ended in one, or the process ended otherwise, or said nothing in time.
        """
        if until is not None and not self._lines.poll(max(until - time.monotonic(), 0.0)):
            raise ScenarioError(f"{self._name} did not start in time")
        try:
            failed, line = self._lines.recv()
        except EOFError:
            self._process.join()
            if self._process.exitcode:
                raise ScenarioError(
                    f"{self._name} ended with status {self._process.exitcode}; what it said is above. What "
                    "had been saved is kept: run the command again"
                ) from None
            return None
        if failed:
            raise ScenarioError(line)
        return line

    def interrupt(self) -> None:
        """As Ctrl-C does."""
        os.kill(self._process.pid or 0, signal.SIGINT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._lines.close()


def _work(parent: int, said: Connection, work: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    end_with_parent(parent)
    # A shell has its background jobs ignore Ctrl-C, and their children inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        work(*arguments, lambda line: said.send((False, line)))
    except ScenarioError as err:
        said.send((True, str(err)))
    except KeyboardInterrupt:
        pass
