"""Runs a command so that what it is refused, by us or by the system, and what stops it, are one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress

from lerobot_roborecover.cli.output import CLOSED_PIPE, accept_all_text, flush_output, output_is_closed
from lerobot_roborecover.errors import RoboRecoverError, os_error_line
from lerobot_roborecover.utils.signals import status_of, stop_signals_raise


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
