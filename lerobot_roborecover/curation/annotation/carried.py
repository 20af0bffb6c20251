"""Votes and example pictures that follow candidates into another dataset: a joined or a repaired one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.examples import EXAMPLES_FOLDER
from lerobot_roborecover.curation.annotation.votes import SCHEMA_VERSION as VOTES_SCHEMA
from lerobot_roborecover.curation.annotation.votes import VOTES_FOLDER, ballot
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.errors import InUseError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write, check_unlocked
from lerobot_roborecover.utils.journal import read_journal


def gather_votes(sources: Sequence[Path], root: Path, there: set[str]) -> dict[str, list[dict[str, Any]]]:
    """Every annotator's records on candidates that are here, those of a candidate in their order.

    Raises:
        ScenarioError: a journal is damaged, two disagree on what came after what, or votes that the dataset
            already has would be lost.
    """
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for folder in (*sources, root):
        for path in sorted((folder / FOLDER / VOTES_FOLDER).glob("*.jsonl")):
            mine = found.setdefault(path.stem, {})
            for candidate, records in _by_candidate(path).items():
                known = mine.get(candidate, [])
                shorter, longer = sorted((known, records), key=len)
                if longer[: len(shorter)] != shorter:
                    raise ScenarioError(
                        f"{path}: votes of {path.stem} on {candidate} differ from another source's, and "
                        "neither goes on from the other. Keep one of the two files"
                    )
                if folder == root and candidate not in there and len(records) > len(known):
                    raise ScenarioError(
                        f"{path}: votes of {path.stem} on {candidate}, whose episode is not here, are in no "
                        "source. Name the dataset that has them, or move the file away"
                    )
                mine[candidate] = longer
    kept = {
        name: [r for candidate, records in mine.items() if candidate in there for r in records]
        for name, mine in found.items()
    }
    return {name: records for name, records in kept.items() if records}


def _by_candidate(path: Path) -> dict[str, list[dict[str, Any]]]:
    """A journal's records by the candidate that they are about."""
    records = read_journal(path, VOTES_SCHEMA)
    try:
        for number in {r.get("round") for r in records}:
            ballot(records, number)  # whole, or refused here
        about = {r["uid"]: r["candidate"] for r in records if r["kind"] == "vote"}
        found: dict[str, list[dict[str, Any]]] = {}
        for record in records:
            candidate = record["candidate"] if "candidate" in record else about[record["uid"]]
            found.setdefault(candidate, []).append(record)
    except (KeyError, TypeError, ScenarioError) as err:
        raise ScenarioError(f"{path} is not an annotator's journal: {err}") from None
    return found


def write_votes(
    root: Path, votes: Mapping[str, Sequence[Mapping[str, Any]]], folder: Path | None = None
) -> None:
    """Writes every annotator's records, unless the dataset has just these.

    Args:
        root: the dataset.
        votes: records by annotator.
        folder: of an update of the dataset, which takes the files; None writes to `root`.

    Raises:
        ScenarioError: an annotator is at work on them.
    """
    for name, records in votes.items():
        path = f"{FOLDER}/{VOTES_FOLDER}/{name}.jsonl"
        try:
            check_unlocked(root / path)
        except InUseError as err:
            raise ScenarioError(str(err)) from None
        if read_journal(root / path, VOTES_SCHEMA) != list(records):
            atomic_write((folder or root) / path, "".join(json.dumps(r) + "\n" for r in records))


def copy_examples(folders: Sequence[Path], root: Path, folder: Path | None = None) -> None:
    """Copies pictures for the annotators' guide, the first source's where several have one of a name.

    Args:
        folders: the sources.
        root: the dataset that has none of a name yet.
        folder: of an update of the dataset, which takes the files; None writes to `root`.
    """
    for source in folders:
        for path in sorted((source / FOLDER / EXAMPLES_FOLDER).glob("*")):
            name = f"{FOLDER}/{EXAMPLES_FOLDER}/{path.name}"
            target = (folder or root) / name
            if path.is_file() and not (root / name).exists() and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
