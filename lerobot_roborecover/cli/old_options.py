"""Options that had another name before: the old name works for one release, and says the new one."""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress
from typing import Any, cast


def renamed(parser: argparse._ActionsContainer, new: str, *old: str) -> None:
    """Takes an option's old names, too: they set the same value, and are in no help.

    Args:
        parser: of a command, or a group of its options. It has the new name, which is not required.
        new: the option's name.
        old: those that it had.
    """
    option = parser._option_string_actions[new]
    parser._add_action(OldName(option, new, old))


class OldName(argparse.Action):
    """Hands what is given on to the option of the new name."""

    def __init__(self, option: argparse.Action, new: str, old: tuple[str, ...]) -> None:
        assert not option.required, f"{new}: argparse would ask for it beside {old}"
        super().__init__(
            old, option.dest, nargs=option.nargs, const=option.const, default=argparse.SUPPRESS,
            type=cast(Any, option.type), choices=option.choices, metavar=option.metavar,
            help=argparse.SUPPRESS,
        )  # fmt: skip
        self.new = new
        self._option = option
        self._noted: argparse.Namespace | None = None

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Says the new name, once for each command line, and sets the value."""
        if self._noted is not namespace:
            self._noted = namespace
            with suppress(OSError):  # standard error may be closed
                print(f"note: {option_string} is now {self.new}", file=sys.stderr)
        self._option(parser, namespace, values, self.new)
