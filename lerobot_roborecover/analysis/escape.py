"""Escapes text from logs for Markdown, CSV and LaTeX. Jinja escapes HTML (`analysis/pages/page.py`).

Names of policies, scenarios and tasks in a log are untrusted; none may become markup or a formula.
"""

from __future__ import annotations

import re

_INSIDE = re.compile(r"[\\`*|~$]|(?<![^\W_])_|_(?![^\W_])|\](?=[(\[:])|\[(?=\^)")
"""What Markdown, or GitHub's tables and mathematics, reads anywhere in a line."""
_START = re.compile(r"#|[-+](?=\s)|=+\s*$|-+\s*$|\d+(?=[.)](\s|$))")
"""What makes a heading, a list or a rule of a line that starts with it."""
_HTML = {"<": "&lt;", ">": "&gt;"}
_ENTITY = re.compile(r"&(?=#?\w+;)")


def markdown(text: str, *, cell: bool = False) -> str:
    """One line of Markdown that shows a text as it is: no HTML, link, picture, emphasis or heading.

    Args:
        text: any.
        cell: whether it becomes a part of a line, such as a table's cell, and not a line of its own.
    """
    line = _ENTITY.sub("&amp;", " ".join(text.split()))
    line = _INSIDE.sub(lambda found: f"\\{found[0]}", line)
    if not cell and (found := _START.match(line)):
        end = found.end() if found[0].isdigit() else 0
        line = f"{line[:end]}\\{line[end:]}"
    return "".join(_HTML.get(character, character) for character in line)


def markdown_alt(text: str) -> str:
    """Words for a picture that is not seen, between the brackets of Markdown's `![words](file)`."""
    return markdown(text, cell=True).replace("\\]", "]").replace("[", "\\[").replace("]", "\\]")


_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
"""What makes a spreadsheet take a cell for a formula; the wide ones in some languages."""


def csv_text(text: str) -> str:
    """A text cell of a CSV file that no spreadsheet runs as a formula."""
    return f"'{text}" if text.lstrip(" \"'").startswith(_FORMULA) or text.startswith(_FORMULA) else text


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"$|$",
    '"': "''",
    "\n": " ",
    "×": r"$\times$",
    "−": "--",
}


def latex(text: str) -> str:
    """Text for LaTeX: nothing in it is a command."""
    return "".join(_LATEX.get(character, character) for character in text)
