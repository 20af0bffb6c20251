"""Names of policies that a reader cannot tell apart: other letters of the same look, or invisible characters.

The letters are those of Greek and Cyrillic that Unicode's table of confusable characters (UTS 39) gives for
letters of Latin; NFKC brings full-width and other forms of one character together.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import zip_longest
from unicodedata import category, name, normalize

from lerobot_roborecover.analysis.stats.estimators import RowsError

_LETTERS = str.maketrans(
    "АВЕЅІЈКМНОРСТХУԌԚԜЗаеѕіјорсухһԁԛԝ" + "ΑΒΕΖΗΙΚΜΝΟΡΤΥΧαγινορυ",
    "ABESIJKMHOPCTXYGQW3aesijopcyxhdqw" + "ABEZHIKMNOPTYXayivopu",
)


def look(text: str) -> str:
    """Returns what a name looks like; names of one look cannot be distinguished."""
    visible = (c for c in normalize("NFKC", text) if category(c) != "Cf")
    return " ".join("".join(visible).translate(_LETTERS).split())


def check_names(names: Iterable[str]) -> None:
    """Refuses policies whose names look alike.

    Raises:
        RowsError: two do; says in which character they differ.
    """
    known: dict[str, str] = {}
    for found in sorted(names):
        other = known.setdefault(look(found), found)
        if other != found:
            raise RowsError(
                f"two policies have names that look alike, {other!r} and {found!r}: "
                f"{_difference(other, found)}. Give one another name: NAME=LOG"
            )


def _difference(one: str, other: str) -> str:
    at, (a, b) = next((k, pair) for k, pair in enumerate(zip_longest(one, other), 1) if pair[0] != pair[1])
    return f"character {at} is {_called(a)} in the one and {_called(b)} in the other"


def _called(character: str | None) -> str:
    if character is None:
        return "no character"
    return f"U+{ord(character):04X} {name(character, 'without a name')}"
