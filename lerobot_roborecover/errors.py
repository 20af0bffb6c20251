"""The one base of everything that this package refuses: a message that says what, the value, the limit and
the remedy, and that every command prints as one line."""

from __future__ import annotations

MAX_SEED = 2**63


class RoboRecoverError(Exception):
    """Something cannot be used or done; the message is all that a user needs."""


class OptionError(RoboRecoverError, ValueError):
    """An option's value cannot be used; the message names it, the limit and the remedy."""


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
