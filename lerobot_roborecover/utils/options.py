"""Options of commands as fields of dataclasses: each is written once.

A field's name, type, default and docstring are the option: an argument of the command (`cli/arguments.py`)
and a parameter in Python. Fields that are dataclasses themselves add their own options to the same command.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import re
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass
from enum import Enum
from functools import cache
from pathlib import PurePath
from typing import Any

from lerobot_roborecover.errors import OptionError

_KEY = "option"
_COLLECTIONS = (tuple, list, Sequence)


@dataclass(frozen=True)
class OptionSpec:
    """What `option` says of a field beyond its type and its default."""

    name: str = ""
    help: str = ""
    metavar: str | tuple[str, ...] | None = None
    choices: tuple[str, ...] | None = None
    old: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    text: str | None = None
    nargs: str | int | None = None
    const: Any = None
    positional: bool = False
    group: str = ""
    show_default: bool = True
    internal: bool = False
    asked: bool = True
    checkpoint: bool = False


def option(
    default: Any = MISSING,
    *,
    factory: Any = MISSING,
    parse: Callable[[str], Any] | None = None,
    text: str | None = None,
    **spec: Any,
) -> Any:
    """A field with more to say than its type and default.

    Args:
        default: its default; without one it is required.
        factory: makes the default.
        parse: reads the value from one word.
        text: the default as it is written, for `parse` and for the help; empty shows none.
        spec: any of
            name: of the option, without dashes (the field's, with hyphens; `no-` before that of a switch that
                is on by default);
            help: for the help, where the docstring says something else;
            metavar: stands for the value in the help;
            choices: allowed texts, where the type does not say them;
            old: names that the option had before, without dashes; they work for one release;
            nargs: as argparse takes it, where the type does not say it;
            const: value of an option that is given without one (`nargs="?"`);
            positional: an argument without a name;
            group: heading in the help of a nested dataclass's options;
            show_default: whether the default is shown: in the help and in the table of options;
            internal: no option at all;
            asked: False where the command line may lack a required option;
            checkpoint: names a policy's checkpoint, `[NAME=]CHECKPOINT`, which is checked before the command
                imports LeRobot.
    """
    made = OptionSpec(parse=parse, text=text, **spec)
    if factory is not MISSING:
        return dataclasses.field(default_factory=factory, metadata={_KEY: made})
    return dataclasses.field(default=default, metadata={_KEY: made})


def internal(default: Any = MISSING, *, factory: Any = MISSING) -> Any:
    """A field that Python alone sets: no option of the command."""
    return option(default, factory=factory, internal=True)


def parse_shard(text: str, name: str) -> tuple[int, int]:
    """Returns k and n of `k/n`.

    Args:
        text: as it is written.
        name: of the option, for messages.

    Raises:
        OptionError: it is no part, counted from 0.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if not match or not int(match[1]) < int(match[2]):
        raise OptionError(f"{name}={text}: must be k/n with 0 <= k < n, e.g. 0/4")
    return int(match[1]), int(match[2])


def json_object(name: str, what: str) -> Callable[[str], dict[str, Any]]:
    """Returns a reader of JSON objects.

    Args:
        name: of the option, for messages.
        what: the object maps.
    """

    def read(text: str) -> dict[str, Any]:
        try:
            value = json.loads(text)
        except ValueError:
            value = None
        if not isinstance(value, dict):
            raise OptionError(f"{name}={text!r:.80}: a JSON object of {what}")
        return value

    return read


@dataclass(frozen=True)
class Option:
    """An option of a command, as its field and `option` say."""

    name: str
    """Without dashes, e.g. `frame-stride`."""
    kind: Any
    """Type of one value: int, float, str, Path, bool, or an `Enum`."""
    default: Any
    """`dataclasses.MISSING` where it is required."""
    doc: str
    """First paragraph of the docstring."""
    repeated: bool
    """A tuple of any length: an option that may be given again, or several words in one place."""
    count: int
    """Words of one value, where it is more than one; else 0."""
    choices: tuple[str, ...] | None
    spec: OptionSpec
    group: str = ""

    @property
    def key(self) -> str:
        """Its name in YAML and in argparse's namespace."""
        return self.name.replace("-", "_")

    @property
    def required(self) -> bool:
        """Whether it has no default."""
        return self.default is MISSING

    @property
    def help(self) -> str:
        """Returns its text in the help: the docstring, as a phrase, with the default at its end."""
        text = self.doc.removesuffix(".")
        first = text.partition(" ")[0]
        if first[:1].isupper() and first[1:] == first[1:].lower() and not self.spec.help:
            text = text[:1].lower() + text[1:]
        plain = isinstance(self.default, (int, float, str, PurePath, Enum)) and self.spec.text is None
        shown = str(self.default) if plain else self.spec.text or ""
        if "{default}" in text:
            return text.replace("{default}", shown)
        if self.kind is bool or not shown or not self.spec.show_default or text.endswith(")"):
            return text
        return f"{text} ({shown})".strip()


def options_of(kind: type, group: str = "") -> list[Option]:
    """Returns the options of a dataclass in the order of its fields, with those of dataclasses within it."""
    hints, docs = typing.get_type_hints(kind), field_docs(kind)
    found: dict[str, Option] = {}
    for field in dataclasses.fields(typing.cast(Any, kind)):
        spec = field.metadata.get(_KEY, OptionSpec())
        if spec.internal:
            continue
        if dataclasses.is_dataclass(hints[field.name]):
            inner = options_of(hints[field.name], spec.group or group)
        else:
            inner = [_option(field, spec, hints[field.name], docs.get(field.name, ""), group)]
        for one in inner:
            found.setdefault(one.name, one)
    return list(found.values())


def _option(field: dataclasses.Field, spec: OptionSpec, hint: Any, doc: str, group: str) -> Option:
    default = field.default
    if field.default_factory is not MISSING:
        default = field.default_factory()
    name = spec.name or _name(field.name, default)
    # What is parsed is one word, whatever comes of it.
    kind, repeated, count, choices = (str, False, 0, None) if spec.parse else _shape(hint)
    choices = spec.choices or choices
    return Option(name, kind, default, spec.help or doc, repeated, count, choices, spec, group)


def _name(field: str, default: Any) -> str:
    name = field.replace("_", "-")
    return f"no-{name}" if default is True else name


def _shape(hint: Any) -> tuple[Any, bool, int, tuple[str, ...] | None]:
    """Type of one value, whether there may be several, words of one value, and choices."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        some = [one for one in inner if one is not type(None)]
        return _shape(some[0]) if len(some) == 1 else (str, False, 0, None)
    if origin is typing.Literal:
        return str, False, 0, inner
    if origin in _COLLECTIONS:
        if origin is tuple and inner[-1] is not Ellipsis:
            return inner[0], False, len(inner), None
        kind, _, count, choices = _shape(inner[0])
        return kind, True, count, choices
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint, False, 0, tuple(str(one.value) for one in hint)
    return hint, False, 0, None


def make[Options](kind: type[Options], values: Mapping[str, Any]) -> Options:
    """Makes a dataclass from its options' values.

    Args:
        kind: the dataclass.
        values: by `Option.key`; what is missing is the default. A switch says whether it was given.
    """
    hints = typing.get_type_hints(kind)
    given: dict[str, Any] = {}
    for field in dataclasses.fields(typing.cast(Any, kind)):
        spec, hint = field.metadata.get(_KEY, OptionSpec()), hints[field.name]
        if spec.internal:
            continue
        if dataclasses.is_dataclass(hint):
            given[field.name] = make(typing.cast(type, hint), values)
            continue
        one = _option(field, spec, hint, "", "")
        if one.key in values:
            given[field.name] = _value(one, values[one.key])
    return kind(**given)


def _value(one: Option, value: Any) -> Any:
    if one.kind is bool and one.default is True:
        return not value
    if value is None:
        return one.default
    if one.repeated or one.count:
        return tuple(tuple(item) if isinstance(item, list) else item for item in value)
    return one.kind(value) if isinstance(one.kind, type) and issubclass(one.kind, Enum) else value


def checkpoints_of(options: Any) -> list[tuple[str, str]]:
    """Returns the (name, text) of each option of a command that names a policy's checkpoint.

    Args:
        options: the command's dataclass.
    """
    found = []
    for field in dataclasses.fields(options):
        spec, value = field.metadata.get(_KEY, OptionSpec()), getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            found += checkpoints_of(value)
        elif spec.checkpoint and value:
            name = spec.name or _name(field.name, None)
            found += [(name, str(text)) for text in (value if isinstance(value, tuple) else (value,))]
    return found


def field_docs(kind: type) -> dict[str, str]:
    """Returns the first paragraph of each field's docstring, of inherited fields too, by the field's name."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found |= _module_docs(base.__module__).get(base.__qualname__, {}) if base is not object else {}
    return found


@cache
def _module_docs(module: str) -> Mapping[str, Mapping[str, str]]:
    """By class and field: docstrings, which only the source has; nothing where there is no source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return {}
    return {node.name: _class_docs(node) for node in tree.body if isinstance(node, ast.ClassDef)}


def _class_docs(node: ast.ClassDef) -> dict[str, str]:
    found = {}
    for field, doc in zip(node.body, node.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(doc, ast.Expr)
            and isinstance(doc.value, ast.Constant)
            and isinstance(doc.value.value, str)
        ):
            found[field.target.id] = " ".join(doc.value.value.split("\n\n")[0].split())
    return found


def move_old_fields(config: Any, prefix: str, names: Mapping[str, str]) -> None:
    """Moves values given under old names to the fields of today, and prints the new names.

    Args:
        config: a dataclass whose old fields are None where they are not given.
        prefix: of its options on the command line, e.g. `--env.`.
        names: old field to new field.
    """
    for old, new in names.items():
        value = getattr(config, old)
        if value is None:
            continue
        setattr(config, new, value)
        setattr(config, old, None)
        with suppress(OSError):  # standard error may be closed
            print(f"note: {prefix}{old} is now {prefix}{new}", file=sys.stderr)
