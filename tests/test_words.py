"""Docs and docstrings keep to the field's words."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lerobot_roborecover"
WORDS = re.compile(
    r"\b(whoever|nobody|somebody|anybody|no say|has a say)\b"
    r"|(?<![-`\w])(films?|filmed|stepping in|scripted drivers?)\b",
    re.IGNORECASE,
)
"""Words without a referent: name the policy, the user, the trial. Words that the field does not use: it says
video or frames, intervention timing, scripted controller."""
NAMES = re.compile(
    r"Film[A-Z]?\w*|Driven|Driver|Shaken\w*|Company|Sitting|Glimpse|TrialWatch|Watcher|Cockpit|Ballot|Judging|Workplace|"
    r"_*(film|shaken|portable|cannot_drive|turned_pictures|needs_help|stepping_in)(_\w+)?",
)
"""Identifiers that other names have replaced."""
EARLIER = {"portable"}
"""Fields that take an earlier option's value."""


@pytest.mark.slow
def test_docstrings_name_what_they_speak_of():
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                text = node.value.value
                if isinstance(text, str) and (word := WORDS.search(text)):
                    found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {word[0]}")
    assert not found, "\n".join(found)


def test_pages_name_what_they_speak_of():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = [
        f"{page.relative_to(ROOT)}:{number}: {word[0]}"
        for page in pages
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if (word := WORDS.search(line))
    ]
    assert not found, "\n".join(found)


@pytest.mark.slow
def test_code_has_the_fields_names():
    found = []
    for file in sorted([*PACKAGE.rglob("*.py"), *(ROOT / "recipes").rglob("*.py")]):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            names = [getattr(node, part, None) for part in ("name", "id", "attr", "arg")]
            found += [
                f"{file.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}: {name}"
                for name in names
                if isinstance(name, str) and NAMES.fullmatch(name) and name not in EARLIER
            ]
    assert not found, "\n".join(found)
