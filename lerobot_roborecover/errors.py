"""The one base of everything that this package refuses: a message that says what, the value, the limit and
the remedy, and that every command prints as one line."""

from __future__ import annotations

import errno
import os
from collections.abc import Generator
from contextlib import contextmanager, suppress

MAX_SEED = 2**63


class RoboRecoverError(Exception):
    """Something cannot be used or done; the message is all that a user needs."""

    exit_status = 2
    """Of a command that ends with it."""


class OptionError(RoboRecoverError, ValueError):
    """An option's value cannot be used; the message names it, the limit and the remedy."""


class ScenarioError(RoboRecoverError, ValueError):
    """A scenario, or a file that holds one, is not usable; the message says which field, the value and the
    limit."""


_REMEDIES = {
    errno.ENOSPC: "Make room on that disk, then run the command again",
    errno.EDQUOT: "Your quota of that disk is used up: make room, then run the command again",
    errno.EFBIG: "Raise the limit for the size of a file (ulimit -f), then run the command again",
    errno.EACCES: "Check its permissions, or name another path",
    errno.EPERM: "Check its permissions, or name another path",
    errno.EROFS: "That file system is mounted read-only: name another path",
    errno.ENOENT: "Check the spelling",
    errno.ENOTDIR: "Name a path whose parents are folders",
    errno.EISDIR: "Name a file",
    errno.EMFILE: "Raise the limit of open files (ulimit -n), or use fewer processes",
    errno.EIO: "Check that disk, then run the command again",
}
_OF_DISKS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
_WRITING = (*_OF_DISKS, errno.EACCES, errno.EPERM)


@contextmanager
def naming(path: object) -> Generator[None]:
    """Adds a path to an `OSError` that has none: a full disk is reported without the name of the file.

    Args:
        path: the file or folder that the block writes.
    """
    try:
        yield
    except OSError as err:
        if err.errno in _OF_DISKS and err.filename is None:
            with suppress(AttributeError):  # some libraries' own classes keep it read-only
                err.filename = str(path)
        raise


def os_error_line(error: OSError) -> str:
    """Returns one line with the path, the reason and the remedy of an error of the operating system."""
    if error.errno is None:
        return " ".join(str(error).split())[:500] or type(error).__name__
    # A library's text, such as Arrow's, may say where in its own code the error was found.
    reason = os.strerror(error.errno) if error.errno in _REMEDIES else " ".join(str(error.strerror).split())
    where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
    parts = [f"{where}{reason}", _REMEDIES.get(error.errno, "")]
    parts += ["Finished trials are kept"] if error.errno in _WRITING else []
    return ". ".join(filter(None, parts))


def check_seed(seed: int | None, option: str = "--seed") -> None:
    """Checks a seed of random draws.

    Args:
        seed: None draws without one, and is accepted.
        option: what the user calls it.

    Raises:
        OptionError: no generator takes it.
    """
    if seed is not None and not 0 <= seed < MAX_SEED:
        raise OptionError(f"{option}={seed}: must be from 0 to {MAX_SEED - 1}")


class InUseError(RoboRecoverError, RuntimeError):
    """Another process has the file open; the message names the file."""
