"""A dataclass as the arguments of a command: help, values, refusals."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

import pytest

from lerobot_roborecover.cli.arguments import Parser, add_options, read_options
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.options import internal, json_object, make, option, options_of


class Colour(StrEnum):
    RED = "red"
    DARK_BLUE = "dark_blue"


def numbers(text: str) -> tuple[int, ...]:
    if "x" in text:
        raise OptionError(f"--numbers={text}: numbers, e.g. 1,2")
    return tuple(int(word) for word in text.split(",") if word)


@dataclass(frozen=True)
class Inner:
    """Options of their own, in the same command."""

    size: int = 3
    """Of the `thing`.

    For readers of the code only.
    """
    colour: Colour | None = None
    """What it looks like (default: as found)."""
    shown: bool = True
    """Do not show it."""
    hidden: str = internal("for Python alone")


@dataclass(frozen=True)
class Twice:
    """A size that two parts take."""

    inner: Inner = field(default_factory=Inner)
    size: int = 3


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A command."""

    sources: tuple[Path, ...] = option(positional=True)
    """Folders to read."""
    rate: float
    """Of %d steps a second."""
    how: Literal["slow", "fast"] = "slow"
    """LIBERO's way ({default} is safe)."""
    inner: Inner = field(default_factory=Inner)
    stride: int = option(1, metavar="N", old=("every",))
    """Every Nth."""
    names: tuple[str, ...] = option((), name="name", metavar="NAME")
    """May be given again."""
    numbers: tuple[int, ...] = option((1, 2), text="1,2", parse=numbers)
    """Those that count."""
    names_of: dict[str, str] = option(factory=dict, name="map", parse=json_object("--map", "names"))
    """Other names."""
    pair: tuple[str, str] = option(("a", "b"), metavar=("A", "B"))
    """Two (a b)."""
    quick: bool = False
    """Skip what is slow."""


def parser() -> Parser:
    made = Parser(prog="roborecover example")
    add_options(made, Outer)
    return made


def read(text: str) -> Outer:
    return read_options(Outer, parser().parse_args(text.split()))


def refused(text: str, capsys) -> str:
    with pytest.raises(SystemExit) as raised:
        read(text)
    assert raised.value.code == 2
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert said.out == ""
    return line.removeprefix("roborecover example: ")


def test_what_is_not_given_is_the_dataclass_s_default():
    assert read("a b --rate 2") == Outer(sources=(Path("a"), Path("b")), rate=2.0)
    assert make(Outer, {"sources": ["a"], "rate": 1}).inner == Inner()


def test_every_kind_of_option_is_read():
    text = (
        "a --rate 2 --how fast --size 4 --colour dark_blue --no-shown --stride 5 --name x --name y "
        "--numbers 3 --pair c d --quick"
    )
    assert read(text) == Outer(
        sources=(Path("a"),), rate=2.0, how="fast", inner=Inner(4, Colour.DARK_BLUE, False), stride=5,
        names=("x", "y"), numbers=(3,), pair=("c", "d"), quick=True,
    )  # fmt: skip


def test_abbreviations_and_old_names_work(capsys):
    assert read("a --rat 2 --every 7 --col red").stride == 7
    assert capsys.readouterr().err == "note: --every is now --stride\n"


def test_help_is_the_docstrings_with_the_defaults():
    text = " ".join(parser().format_help().split())
    for said in (
        "sources folders to read",
        "--rate RATE of %d steps a second",
        "--how {slow,fast} LIBERO's way (slow is safe)",
        "--size SIZE of the `thing` (3)",
        "--colour {red,dark_blue} what it looks like (default: as found)",
        "--no-shown do not show it",
        "--stride N every Nth (1)",
        "--name NAME may be given again",
        "--numbers NUMBERS those that count (1,2)",
        "--pair A B two (a b)",
        "--quick skip what is slow",
    ):
        assert said in text
    assert "readers of the code" not in text
    assert "--every" not in text
    assert "hidden" not in text


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a --rat 2 --siez 3", "there is no option --siez; the nearest is --size"),
        ("a --sterid 3", "there is no option --sterid; the nearest is --stride"),
        ("a --xyzzy=3", 'there is no option --xyzzy; "roborecover example --help" lists them'),
        ("a --rate 2 --how fats", "argument --how: 'fats' is not one of slow, fast; the nearest is fast"),
        (
            "a --rate 2 --colour drak_blue",
            "argument --colour: 'drak_blue' is not one of red, dark_blue; the nearest is dark_blue",
        ),
        ("a --rate x", "argument --rate: invalid float value: 'x'"),
        ("a --rate 2 --numbers ?", "argument --numbers: invalid numbers value: '?'"),
        ("a", "the following arguments are required: --rate"),
        ("--rate 2", "the following arguments are required: sources"),
    ],
)
def test_a_refusal_is_one_line_that_names_what_is_near(text, line, capsys):
    assert refused(text, capsys) == line


def test_a_refusal_of_ours_keeps_its_words():
    for text, said in (
        ("a --rate 2 --numbers x", "--numbers=x: numbers, e.g. 1,2"),
        ("a --rate 2 --map [1]", "--map='[1]': a JSON object of names"),
        ("a --rate 2 --map {", "--map='{': a JSON object of names"),
    ):
        with pytest.raises(OptionError) as raised:
            read(text)
        assert str(raised.value) == said
    assert read('a --rate 2 --map {"x":"y"}').names_of == {"x": "y"}


def test_what_follows_two_dashes_is_no_option():
    assert read("--rate 2 -- --siez").sources == (Path("--siez"),)


def test_options_of_another_parser_are_passed_on(capsys):
    class Passing(Parser):
        passes = ("--env.",)

    made = Passing(prog="roborecover example")
    add_options(made, Outer)
    args, rest = made.parse_known_args(["a", "--rate", "2", "--env.type=x"])
    assert read_options(Outer, args).rate == 2.0
    assert rest == ["--env.type=x"]


def test_a_name_in_two_places_is_one_option():
    assert [one.name for one in options_of(Twice)] == ["size", "colour", "no-shown"]
    assert make(Twice, {"size": 5}) == Twice(Inner(5), 5)
