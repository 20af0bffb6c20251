"""docs/architecture.md and the table of rooms in CONTRIBUTING.md name files, rooms and names that exist."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "lerobot_roborecover"
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
PICTURE = re.findall(r"```mermaid\n(.*?)```", PAGE, re.DOTALL)[0]
OUTSIDE = ("tests/", "scripts/", "examples/", "pyproject.toml")
"""Beginnings of paths of the page that are not inside the package."""
ROOMS = sorted(
    folder.name
    for folder in PACKAGE.iterdir()
    if folder.is_dir() and folder.name not in ("data", "__pycache__") and next(folder.rglob("*.py"), None)
)
SOURCES = {file: file.read_text("utf-8") for file in PACKAGE.rglob("*.py")}


def code_spans(text: str) -> list[str]:
    return re.findall(r"`([^`\n]+)`", text)


def files_in(text: str) -> list[str]:
    """Paths and file names in code spans, in their order, each once."""
    return list(dict.fromkeys(s for s in code_spans(text) if re.fullmatch(r"[\w./-]+\.(py|sh|toml)", s)))


def rows_of_contributing() -> Iterator[tuple[list[str], str]]:
    """Paths in the first column of "Where things live", and the second column."""
    page = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    section = page.split("## Where things live\n")[1].split("\n## ")[0]
    _, _, *rows = [line for line in section.splitlines() if line.startswith("|")]
    for line in rows:
        _, first, second, _ = line.split("|")
        yield code_spans(first), second


def walks() -> Iterator[tuple[int, str]]:
    """The number of files that each walk claims, and its table."""
    for match in re.finditer(
        r"^\*\*[^*]+: (\d+) files\.\*\*.*?\n\n(\|.*?)\n\n", PAGE, re.DOTALL | re.MULTILINE
    ):
        yield int(match[1]), match[2]


@pytest.mark.parametrize("name", files_in(PAGE))
def test_a_file_of_the_page_exists(name):
    root = ROOT if name.startswith(OUTSIDE) else PACKAGE
    assert (root / name).is_file()


def test_files_and_folders_of_contributing_exist():
    missing, folder = [], PACKAGE
    assert len(list(rows_of_contributing())) > 20
    for paths, about in rows_of_contributing():
        for path in paths:
            found = next((f for f in (ROOT / path, PACKAGE / path) if f.exists()), None)
            if found is None:
                missing.append(path)
                continue
            folder = found if found.is_dir() else found.parent
        missing += [name for name in files_in(about) if not (folder / name).is_file()]
    assert not missing


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_is_named_and_in_the_picture(room):
    assert f"`{room}/" in PAGE or re.search(rf"\b{room}[\[(]", PICTURE)


def test_an_arrow_of_the_picture_is_an_import():
    arrows = re.findall(r"^ *(\w+)(?:[\[(].*?[\])])? --> (\w+)", PICTURE, re.MULTILINE)
    arrows = [(a, b) for a, b in arrows if a in ROOMS]
    assert len(arrows) > 10
    for user, used in arrows:
        imports = f"lerobot_roborecover.{used}"
        there = any(imports in text for file, text in SOURCES.items() if PACKAGE / user in file.parents)
        assert there, f"{user} does not import {used}"


def test_a_walk_has_as_many_files_as_it_says():
    found = list(walks())
    assert len(found) == 3
    for count, table in found:
        assert len(files_in(table)) == count


@pytest.mark.slow
def test_functions_and_classes_of_the_page_exist():
    missing = []
    for span in code_spans(PAGE):
        match = re.fullmatch(r"(?:([A-Z]\w+)\.)?(\w+)\(\)", span) or re.fullmatch(
            r"([A-Z][a-z]\w+)(?:\.(\w+))?", span
        )
        if match is None:
            continue
        names = [name for name in match.groups() if name]
        if not any(all(re.search(rf"\b(class|def) {n}\b", text) for n in names) for text in SOURCES.values()):
            missing.append(span)
    assert not missing
