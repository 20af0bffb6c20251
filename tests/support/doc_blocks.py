"""Blocks of code of the documentation, and the commands in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
_BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<why>[^>]+) -->\n)?```(?P<language>\w*)[^\n]*\n(?P<code>.*?)^```",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    page: str
    """Path in the repository."""
    line: int
    """Of the page, where the code begins."""
    language: str
    code: str
    why_not_run: str
    """Reason that stands above a block which is not run; else empty."""

    @property
    def name(self) -> str:
        """For the names of tests."""
        return f"{self.page}:{self.line}"


def section(page: str, heading: str) -> str:
    """The one part of a page, up to the next heading, whose heading begins like this."""
    (found,) = (part for part in re.split("^(?=#)", page, flags=re.MULTILINE) if part.startswith(heading))
    return found


def blocks_of(page: Path) -> list[Block]:
    """All blocks of a page, in order."""
    text = page.read_text("utf-8")
    return [
        Block(
            str(page.relative_to(ROOT)),
            text.count("\n", 0, m.start("code")) + 1,
            m["language"],
            m["code"],
            m["why"] or "",
        )
        for m in _BLOCK.finditer(text)
    ]


def all_blocks(language: str) -> list[Block]:
    """Blocks of one language, of all pages."""
    return [block for page in PAGES for block in blocks_of(page) if block.language == language]


def commands(code: str, program: str) -> Iterator[list[str]]:
    """Arguments of every call of a program in a shell script, without comments and redirections."""
    for line in code.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|;&<>")
        lexer.whitespace_split = True
        lexer.commenters = "#"
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word and set(word) <= set("|;&<>"):
                if program in words:
                    yield words[words.index(program) + 1 :]
                words = []
            else:
                words.append(word)
