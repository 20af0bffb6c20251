"""Makes a command's arguments from its dataclass, and its dataclass from parsed arguments."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, cast

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.policies.checkpoint import check_checkpoint
from lerobot_roborecover.utils.options import Option, checkpoints_of, make, options_of
from lerobot_roborecover.utils.text import nearest


@dataclass(frozen=True)
class OwnCommand:
    """A command with options of its own, where a module holds several (`tree.Command.module`)."""

    HELP: str
    """What it does."""
    OPTIONS: type
    """The dataclass of its options."""
    run: Callable[[Any], int]
    """Given the options; returns the exit status."""


class _RefusedError(Exception):
    """Carries a refusal of ours through argparse, which replaces the text of a `ValueError`."""

    def __init__(self, reason: RoboRecoverError) -> None:
        super().__init__(str(reason))
        self.reason = reason


class Parser(argparse.ArgumentParser):
    """A parser whose refusals are one line, and name what is nearest to what was typed."""

    passes: tuple[str, ...] = ()
    """Beginnings of options that another parser reads."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parses, after a look at the options' names: a wrong one is named before a missing one."""
        words = list(sys.argv[1:] if args is None else args)
        if not any(action.nargs in (argparse.PARSER, argparse.REMAINDER) for action in self._actions):
            self._refuse_unknown(words)
        try:
            return super().parse_known_args(words, namespace)
        except _RefusedError as err:
            raise err.reason from None

    def _refuse_unknown(self, words: Sequence[str]) -> None:
        known = list(self._option_string_actions)
        for word in words:
            if word == "--":
                break
            name = word.partition("=")[0]
            if not name.startswith("--") or " " in word or name.startswith(self.passes or ("---",)):
                continue
            if not any(one.startswith(name) for one in known):
                near = nearest(name, self._visible())
                self.error(
                    f"there is no option {name[:80]}; "
                    + (f"the nearest is {near}" if near else f'"{self.prog} --help" lists them')
                )

    def _visible(self) -> list[str]:
        return [s for a in self._actions if a.help != argparse.SUPPRESS for s in a.option_strings]

    def error(self, message: str) -> NoReturn:
        """Ends with one line, and exit status 2."""
        self.exit(2, f"{self.prog}: {message}\n")


def add_options(parser: argparse.ArgumentParser, kind: type) -> None:
    """Adds the options of a dataclass.

    Args:
        parser: of the command.
        kind: the command's dataclass.
    """
    groups: dict[str, Any] = {"": parser}
    for one in options_of(kind):
        if one.group not in groups:
            groups[one.group] = parser.add_argument_group(one.group)
        place = groups[one.group]
        if one.spec.positional:
            place.add_argument(one.key, **_settings(one))
            continue
        flag = f"--{one.name}"
        place.add_argument(flag, dest=one.key, **_settings(one))
        if one.spec.old:
            renamed(place, flag, *(f"--{old}" for old in one.spec.old))


def read_options[Options](kind: type[Options], namespace: argparse.Namespace) -> Options:
    """Makes a command's dataclass from the arguments that `add_options` added."""
    return make(kind, vars(namespace))


def check_checkpoints(options: Any) -> None:
    """Refuses a policy's checkpoint that cannot be loaded, before the command imports LeRobot.

    Args:
        options: the command's dataclass.

    Raises:
        OptionError: naming the option, and what is nearest to it.
    """
    for name, text in checkpoints_of(options):
        label, path = f"--{name}={text}", text
        if re.match(r"[A-Za-z0-9][\w.-]*=", text) and not Path(text).exists():
            path = text.partition("=")[2]
        check_checkpoint(path, label)


def _settings(one: Option) -> dict[str, Any]:
    """What argparse is told of an option."""
    spec, text = one.spec, one.help.replace("%", "%%")
    if one.kind is bool:
        return {"action": "store_true", "help": text}
    found: dict[str, Any] = {"help": text, "type": _type(one), "metavar": spec.metavar}
    if one.choices:
        found["choices"] = one.choices
    if spec.nargs is not None:
        found["nargs"] = spec.nargs
    elif one.count:
        found["nargs"] = one.count
    elif one.repeated and spec.positional:
        found["nargs"] = "+" if one.required else "*"
    elif spec.positional and not one.required:
        found["nargs"] = "?"
    if one.repeated and not spec.positional and spec.nargs is None:
        found["action"] = "append"
    if spec.const is not None:
        found["const"] = spec.const
    if one.required:
        return found if spec.positional or not spec.asked else {**found, "required": True}
    if not spec.show_default:
        return found
    value = spec.text if spec.parse and spec.text is not None else one.default
    return {**found, "default": list(value) if isinstance(value, tuple) else getattr(value, "value", value)}


def _type(one: Option) -> Callable[[str], Any] | None:
    """Reads one word; refuses with a reason."""
    choices, parse = one.choices, one.spec.parse
    if choices:

        def chosen(text: str) -> str:
            if text in choices:
                return text
            near = nearest(text, choices)
            hint = f"; the nearest is {near}" if near else ""
            raise argparse.ArgumentTypeError(f"{text!r:.80} is not one of {', '.join(choices)}{hint}")

        return chosen
    if parse:

        def parsed(text: str) -> Any:
            try:
                return parse(text)
            except RoboRecoverError as err:
                raise _RefusedError(err) from None

        parsed.__name__ = getattr(parse, "__name__", "value")
        return parsed
    return None if one.kind is str else one.kind


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
