"""Runs a command so that what it is refused, by us or by the system, and what stops it, are one line. Any
text can be printed, and a closed pipe or a full disk ends in good order."""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from lerobot_roborecover.errors import RoboRecoverError, os_error_line
from lerobot_roborecover.utils.signals import status_of, stop_signals_raise

CLOSED_PIPE = 141
"""Exit status of a command whose output was closed: what a shell reports of a program that SIGPIPE ended."""


def accept_all_text() -> None:
    """Has characters that an encoding lacks printed as escapes (`\\u2265`), where Python would raise."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def output_is_closed() -> bool:
    """Returns whether the reader of standard output or error is gone."""
    return any(map(_is_closed, (sys.stdout, sys.stderr)))


def flush_output(name: str) -> int:
    """Writes what is still buffered, so that the interpreter need not at its end, where errors are noisy.

    Args:
        name: of the command, for messages.

    Returns:
        0, or the exit status where the text could not be written.
    """
    status = 0
    for where, stream in (("standard output", sys.stdout), ("standard error", sys.stderr)):
        if stream is None:
            continue
        try:
            stream.flush()
        except BrokenPipeError:
            status = CLOSED_PIPE
        except OSError as err:
            status = 2
            err.filename = where
            _discard(stream)
            with suppress(OSError):
                print(f"{name}: {os_error_line(err)}", file=sys.stderr)
        if _is_closed(stream):
            _discard(stream)
    return status


def _number(stream: Any) -> int | None:
    try:
        return stream.fileno()
    except (OSError, ValueError, AttributeError):  # none, closed, or no file: a test's, or a notebook's
        return None


def _is_closed(stream: Any) -> bool:
    number = _number(stream)
    if number is None:
        return False
    poll = select.poll()
    poll.register(number, 0)
    # POLLHUP is what a pipe without a reader reports on macOS.
    return any(event & (select.POLLERR | select.POLLHUP | select.POLLNVAL) for _, event in poll.poll(0))


def _discard(stream: Any) -> None:
    """Sends what is buffered, and all that follows, nowhere."""
    number = _number(stream)
    if number is not None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, number)
        os.close(nowhere)


def guarded(name: str, work: Callable[[], int]) -> int:
    """Runs a command.

    Args:
        name: begins every line about it.
        work: the command; returns its exit status.

    Returns:
        Exit status: the command's own; 2 refused, or as the error says; 130, 143 or 129 interrupted by
        Ctrl-C, SIGTERM or SIGHUP; 141 standard output was closed, as by `| head`.
    """
    accept_all_text()
    try:
        with stop_signals_raise():
            status = work()
    except SystemExit:  # of argparse
        flush_output(name)
        raise
    except KeyboardInterrupt as err:
        status = _refused(name, "interrupted", status_of(err))
    except BrokenPipeError as err:
        # Another process may have gone as well, such as a server.
        status = CLOSED_PIPE if output_is_closed() else _refused(name, os_error_line(err))
    except RoboRecoverError as err:
        status = _refused(name, str(err), err.exit_status)
    except OSError as err:
        status = _refused(name, os_error_line(err))
    return flush_output(name) or status


def _refused(name: str, why: str, status: int = 2) -> int:
    with suppress(OSError):  # standard error may be closed, too
        print(f"{name}: {why}", file=sys.stderr)
    return status
