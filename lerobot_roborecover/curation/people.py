"""What a dataset says of the people who made it, and a copy that does not.

Votes name their annotators and hold comments, times of day and working seconds: in `votes/NAME.jsonl` of a
candidate dataset, and in the provenance of the scenarios that they resolved to. Decisions name who decided.
All of it is published with the dataset. Operators' names are parts of ids, and stay.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.annotators import is_automatic
from lerobot_roborecover.curation.annotation.votes import SCHEMA_VERSION as VOTES_SCHEMA
from lerobot_roborecover.curation.annotation.votes import VOTES_FOLDER
from lerobot_roborecover.curation.candidates import CANDIDATES_FILE, read_candidates
from lerobot_roborecover.curation.funnel import DECISIONS_FILE, SCHEMA_VERSION, read_decisions
from lerobot_roborecover.datasets import write_scenarios
from lerobot_roborecover.datasets.contents import list_files
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.datasets.read import read_with_manifest
from lerobot_roborecover.datasets.schema import FOLDER, SCENARIOS_FILE
from lerobot_roborecover.scenario import Scenario, ScenarioError, Source
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.journal import read_journal

PSEUDONYM = "annotator-{}"
INSPECTION = "rejected on inspection"
"""Reason of the decisions that a person made by looking: `detail` is that person's words."""
_NOBODY = "a person"
_VOTES_OF = re.compile(r"(votes(?:, some automatic,)?) of (.+)")


@dataclass(frozen=True)
class People:
    """Personal data in a dataset. Annotating programs are not people."""

    names: tuple[str, ...] = ()
    """Names of annotators and of inspectors who rejected scenarios, in an order that tells nothing."""
    votes: int = 0
    """In these files and in scenarios' provenance."""
    times: int = 0
    """Votes and decisions with the time of day at which they were made."""
    seconds: int = 0
    """Votes with the time that was spent."""
    comments: int = 0
    """Comments of votes, and reasons given on inspection."""
    decisions: int = 0
    """That name a person."""
    operators: tuple[str, ...] = ()
    """Controllers of human recordings: parts of ids, clusters and sources."""

    def __bool__(self) -> bool:
        return bool(self.names or self.votes or self.operators)

    def lines(self, anonymised: bool) -> list[str]:
        """What publishing tells of them, for people.

        Args:
            anonymised: the names, comments, times and seconds are left out.
        """
        found = []
        if self.names or self.votes:
            what = (
                f"names ({', '.join(self.names)}), {self.comments} comments, {self.times} times of day, "
                f"{self.seconds} working times, of {self.votes} votes and {self.decisions} decisions"
            )
            found.append(
                f"people    left out: {what}; names are {PSEUDONYM.format(1)} to {len(self.names)} instead"
                if anonymised
                else f"people    PUBLISHED with it: {what}. Leave them out with --anonymise"
            )
        if self.operators:
            found.append(
                f"operators PUBLISHED with it: {', '.join(self.operators)}; they are parts of ids of human "
                "recordings, and stay"
            )
        return found


def find_people(root: Path) -> People:
    """Finds the personal data in a dataset of any kind.

    Raises:
        ScenarioError: a file of it is damaged.
    """
    votes = {p: read_journal(p, VOTES_SCHEMA) for p in _vote_files(root)}
    human = {p: records for p, records in votes.items() if not is_automatic(p.stem)}
    scenarios = read_with_manifest(root)[0] if (root / FOLDER / SCENARIOS_FILE).is_file() else []
    cast = [r for records in human.values() for r in records if r.get("kind") == "vote"]
    cast += [v for s in scenarios for v in _provenance_votes(s) if not is_automatic(str(v.get("annotator")))]
    decisions = read_decisions(root)
    named = [(d, deciders) for d in decisions if (deciders := _deciders(d.by, d.reason))]
    names = {p.stem for p in human} | {str(v.get("annotator")) for v in cast}
    names |= {name for _, deciders in named for name in deciders}
    # By the random number of a vote, where there is one: the order of names would tell something.
    first: dict[str, str] = {}
    for vote in cast:
        name = str(vote.get("annotator"))
        first[name] = min(first.get(name, "~"), str(vote.get("uid")))
    return People(
        names=tuple(sorted(names - {""}, key=lambda n: (first.get(n, "~"), n))),
        votes=len(cast),
        times=sum(bool(v.get("at")) for v in cast) + sum(bool(d.at) for d, _ in named),
        seconds=sum(bool(v.get("seconds")) for v in cast),
        comments=sum(bool(v.get("comment")) for v in cast)
        + sum(bool(d.detail) for d, _ in named if d.reason == INSPECTION),
        decisions=len(named),
        operators=tuple(sorted(_operators(root, scenarios))),
    )


def anonymise(root: Path, target: Path, people: People) -> list[str]:
    """Makes a copy of a dataset without what it says of annotators; large files are linked, not copied.

    Args:
        root: the dataset, left as it is.
        target: a new folder on the same disk.
        people: of `find_people`.

    Returns:
        Files of the copy in which a name still stands, e.g. because it is an operator's too.
    """
    names = {name: PSEUDONYM.format(i) for i, name in enumerate(people.names, 1)}
    taken = {p.stem for p in _vote_files(root)} & set(names.values()) - set(names)
    if taken:
        raise ScenarioError(
            f"{root} has votes of {sorted(taken)[0]!r} already, which is a pseudonym given here; rename it"
        )
    rewritten = set()

    def put(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
        atomic_write(path, "".join(json.dumps(r, ensure_ascii=False) + "\n" for r in records))

    for path in _vote_files(root):
        rewritten.add(path.relative_to(root).as_posix())
        records = [_without_vote(r, names) for r in read_journal(path, VOTES_SCHEMA)]
        put(target / FOLDER / VOTES_FOLDER / f"{names.get(path.stem, path.stem)}.jsonl", records)
    decisions = root / FOLDER / DECISIONS_FILE
    if decisions.is_file():
        rewritten.add(f"{FOLDER}/{DECISIONS_FILE}")
        records = [_without_decider(r, names) for r in read_journal(decisions, SCHEMA_VERSION)]
        put(target / FOLDER / DECISIONS_FILE, records)
    if (root / FOLDER / SCENARIOS_FILE).is_file():
        rewritten |= {n for n in list_files(root) if n.startswith(f"{FOLDER}/frames/")}
        rewritten |= {f"{FOLDER}/{SCENARIOS_FILE}", f"{FOLDER}/manifest.json"}
        scenarios, manifest = read_with_manifest(root)
        write_scenarios(
            target,
            [_without_votes(s, names) for s in scenarios],
            description=manifest.get("description", ""),
            license=manifest.get("license"),
            frames=FrameStore(root).values(),
        )
    for name in list_files(root):
        if name not in rewritten:
            _link(root / name, target / name)
    return _still_named(target, people.names)


def _vote_files(root: Path) -> list[Path]:
    return sorted((root / FOLDER / VOTES_FOLDER).glob("*.jsonl"))


def _provenance_votes(scenario: Scenario) -> list[dict[str, Any]]:
    annotation = scenario.provenance.get("annotation")
    votes = annotation.get("votes") if isinstance(annotation, dict) else None
    return [v for v in votes if isinstance(v, dict)] if isinstance(votes, list) else []


def _operators(root: Path, scenarios: Iterable[Scenario]) -> set[str]:
    found = {s.source_policy for s in scenarios if s.source is Source.HUMAN}
    if (root / FOLDER / CANDIDATES_FILE).is_file():
        candidates = read_candidates(root)
        human = [e for e, c in enumerate(candidates.candidates) if c.source is Source.HUMAN]
        found |= {candidates.trajectories.rows[e].driver for e in human}
    return found - {""}


def _deciders(by: str, reason: str) -> list[str]:
    """People that a decision names."""
    if reason == INSPECTION:
        return [by] if by not in ("", _NOBODY) else []
    match = _VOTES_OF.fullmatch(by)
    return [n for n in match.group(2).split(", ") if not is_automatic(n)] if match else []


def _without_vote(record: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """A record of a journal, or a vote of a provenance; a program's stays."""
    if "annotator" not in record or is_automatic(str(record["annotator"])):
        return dict(record)
    name = str(record["annotator"])
    return {**record, "annotator": names.get(name, name), "comment": "", "seconds": 0.0, "at": ""}


def _without_decider(record: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    if not _deciders(record["by"], record["reason"]):
        return dict(record)
    if record["reason"] == INSPECTION:
        return {**record, "by": names[record["by"]], "detail": "", "at": ""}
    match = _VOTES_OF.fullmatch(record["by"])
    if match is None:
        return dict(record)
    voters = sorted(names.get(n, n) for n in match.group(2).split(", "))
    return {**record, "by": f"{match.group(1)} of {', '.join(voters)}", "at": ""}


def _without_votes(scenario: Scenario, names: Mapping[str, str]) -> Scenario:
    if not _provenance_votes(scenario):
        return scenario
    annotation = scenario.provenance["annotation"]
    votes = [_without_vote(v, names) if isinstance(v, dict) else v for v in annotation["votes"]]
    votes.sort(key=lambda v: str(v.get("annotator")) if isinstance(v, dict) else "")
    return replace(scenario, provenance={**scenario.provenance, "annotation": {**annotation, "votes": votes}})


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another disk, or one that has no links
        shutil.copy2(source, target)


def _still_named(root: Path, names: Iterable[str]) -> list[str]:
    words = re.compile("|".join(rf"(?<![\w-]){re.escape(n)}(?![\w-])" for n in names) or "(?!)")
    kinds = (".json", ".jsonl", ".md", ".cff", ".bib", ".txt")
    text = [root / n for n in list_files(root) if n.endswith(kinds)]
    found = [p.relative_to(root).as_posix() for p in text if words.search(p.read_text("utf-8", "replace"))]
    if (root / FOLDER / SCENARIOS_FILE).is_file():
        scenarios = read_with_manifest(root)[0]
        if any(words.search(json.dumps([s.id, s.cluster, s.provenance], default=str)) for s in scenarios):
            found.append(f"{FOLDER}/{SCENARIOS_FILE}")
    return found
