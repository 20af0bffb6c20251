"""How numbers of things and commands are written in what people read."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from urllib.parse import unquote, urlsplit

DISTRIBUTION = "lerobot_env_roborecover"

# tqdm's, with and without a total; other output may begin right behind one.
_PROGRESS_BAR = re.compile(r"[^\r\n]*?(?:\d+%\|[^\r\n]*?|\b\d+it )\[[^\]\r\n]*\]")
_ERROR = re.compile(r"(?:\w+\.)*\w*(?:Error|Exception|Interrupt)\b(?!\s+ignored)")
_PLURALS = {"policy": "policies", "trajectory": "trajectories", "history": "histories"}


def pluralize(number: int, thing: str) -> str:
    """A number of things: `1 candidate`, `2 candidates`.

    Args:
        number: how many.
        thing: one of them; of several words the last is put into the plural.
    """
    if number == 1:
        return f"{number} {thing}"
    *before, last = thing.split(" ")
    return " ".join([str(number), *before, _PLURALS.get(last, f"{last}s")])


def next_command(argv: Sequence[str], what: str = "next") -> str:
    """The line that names the command to run after this one, as a shell takes it.

    Args:
        argv: after `roborecover`; the user replaces words in capitals.
        what: the line's beginning.
    """
    return f"{what}: roborecover {shlex.join(argv)}"


@cache
def install_command(extra: str, name: str = DISTRIBUTION) -> str:
    """The command that installs an extra of a package from where the package came: a clone, or PyPI.

    Args:
        extra: its name; empty for the package itself.
        name: of the distribution.
    """
    from importlib.metadata import distributions

    extras = f"[{extra}]" if extra else ""
    # In the folder of a clone its build's own metadata is found first, which does not say where it came from.
    found = (d.read_text("direct_url.json") for d in distributions(name=name))
    try:
        source = json.loads(next(filter(None, found), "{}"))
    except ValueError:
        source = {}
    if source.get("dir_info", {}).get("editable"):
        return f"uv pip install -e '{unquote(urlsplit(source['url']).path)}{extras}'"
    return f"pip install '{name}{extras}'"


def align(rows: Iterable[Sequence[object]], left: Collection[int] = (0,)) -> list[str]:
    """A table for the terminal, a line a row, columns two spaces apart.

    Args:
        rows: of equal length, the heading among them.
        left: columns that begin below each other; the others, numbers, end below each other.
    """
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i in left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]


def nearest(word: str, known: Iterable[str]) -> str:
    """Returns the name that is most like a word; empty where none is."""
    from difflib import get_close_matches

    return next(iter(get_close_matches(word, list(known), 1)), "")


def format_duration(seconds: float) -> str:
    """A duration as `h:mm:ss`."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def output_end(output: str, most_lines: int) -> tuple[str, str]:
    """Returns why a program failed, and the end of its output, without progress bars.

    Args:
        output: what it printed.
        most_lines: of the end.

    Returns:
        The last line that names an error, else the last line, else nothing; and the last lines, indented.
    """
    lines = [line.rstrip() for line in re.split(r"[\r\n]", _PROGRESS_BAR.sub("", output)) if line.strip()]
    causes = [line.strip() for line in lines if _ERROR.match(line.strip())] or lines[-1:]
    return (causes[-1] if causes else ""), "\n".join(f"  {line}" for line in lines[-most_lines:])


_ABSOLUTE = re.compile(r"(?<![\w./~:-])/(?:[^\s/,='\"]+/)+[^\s/,='\"]+")


def without_folders(text: str) -> str:
    """A text in which absolute paths say their last two parts alone: what is shared does not tell how its
    author's disk is arranged."""
    return _ABSOLUTE.sub(lambda found: "/".join(found[0].rsplit("/", 2)[-2:]), text)
