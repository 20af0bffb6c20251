"""`NAME=PATH` on a command line: what a policy is to be called, and where its files are; `NAME=PATH,PATH` for
several runs of one method."""

from __future__ import annotations

from pathlib import Path
from unicodedata import normalize

from lerobot_roborecover.analysis.stats.estimators import RowsError


def split_named(text: str) -> tuple[str, str]:
    """Name and the rest of `NAME=PATH`; the name is empty where there is none.

    A path may hold "=" itself (`runs/lr=0.1`), a name may not: a text that exists as it stands is a path, any
    other is split at its first "=".

    Raises:
        RowsError: the name is empty or not printable.
    """
    if "=" not in text or Path(text).exists():
        return "", text
    name, _, rest = text.partition("=")
    if not name.strip() or not name.isprintable():
        raise RowsError(f"{text!r}: the name before the first '=' is empty or not printable. Write NAME=PATH")
    return normalize("NFC", name), rest


def split_runs(rest: str) -> list[str]:
    """The paths of `PATH,PATH,...`, one a run.

    A path may hold commas itself: a text that exists as it stands is one path, and of any other each part is
    the longest stretch between commas that exists. What exists nowhere ends at its comma.
    """
    pieces = rest.split(",")
    found, first = [], 0
    while first < len(pieces):
        ends = [k for k in range(len(pieces), first, -1) if Path(",".join(pieces[first:k])).exists()]
        end = ends[0] if ends else first + 1
        found.append(",".join(pieces[first:end]))
        first = end
    return found


def missing(text: str, path: Path) -> str:
    """What to say where nothing lies at a path that came from `text`."""
    if text == str(path):
        return "no such file or folder"
    return (
        f"no such file or folder. In {text!r} what comes before the first '=' is taken for the policy's "
        "name, because nothing exists under the whole text"
    )
