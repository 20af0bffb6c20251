"""How numbers of things and commands are written in what people read."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

_PLURALS = {"policy": "policies", "trajectory": "trajectories", "history": "histories"}


def counted(number: int, thing: str) -> str:
    """A number of things: `1 candidate`, `2 candidates`.

    Args:
        number: how many.
        thing: one of them; of several words the last is put into the plural.
    """
    if number == 1:
        return f"{number} {thing}"
    *before, last = thing.split(" ")
    return " ".join([str(number), *before, _PLURALS.get(last, f"{last}s")])


def next_line(argv: Sequence[str], what: str = "next") -> str:
    """The line that names the command to run after this one, as a shell takes it.

    Args:
        argv: after `roborecover`; words in capitals are for whoever runs it to fill in.
        what: the line's beginning.
    """
    return f"{what}: roborecover {shlex.join(argv)}"


def lasting(seconds: float) -> str:
    """A duration as `h:mm:ss`."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
