"""The one base of everything that this package refuses: a message that says what, the value, the limit and
the remedy, and that every command prints as one line."""

from __future__ import annotations


class RoboRecoverError(Exception):
    """Something cannot be used or done; the message is all that a user needs."""


class OptionError(RoboRecoverError, ValueError):
    """An option's value cannot be used; the message names it, the limit and the remedy."""


class InUseError(RoboRecoverError, RuntimeError):
    """Another process has the file open; the message names the file."""
