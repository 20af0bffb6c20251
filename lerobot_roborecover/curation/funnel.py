"""Counts of the candidates lost at every stage, and their table.

Each stage adds its decisions to `meta/roborecover/decisions.jsonl` of the dataset it writes, after those of
the stages before. The last decision of a stage on a candidate counts, so that one can be taken back by
another, with both on record.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

from lerobot_roborecover.datasets.files import finish_update
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_file
from lerobot_roborecover.utils.journal import Journal, read_journal
from lerobot_roborecover.utils.text import align

DECISIONS_FILE = "decisions.jsonl"
SCHEMA_VERSION = 1

type StageName = Literal["collect", "annotate", "screen", "validate", "split"]
type VerdictName = Literal["kept", "dropped", "undecided"]
STAGES: tuple[str, ...] = get_args(StageName.__value__)
"""In the order of the paper's pipeline; collect stands for every way a trajectory comes in."""


@dataclass(frozen=True)
class Decision:
    """One stage's verdict on one candidate."""

    candidate: str
    """Its id, which is also that of the scenario made from it."""
    stage: StageName
    verdict: VerdictName
    reason: str = ""
    """A few words that many candidates share: a row of the funnel."""
    detail: str = ""
    """What is particular to this candidate: values and limits."""
    by: str = ""
    """The rule, program or person that decided."""
    at: str = ""
    """UTC, ISO 8601; filled in when it is recorded."""


@dataclass(frozen=True)
class StageCounts:
    stage: str
    entered: int
    kept: int
    dropped: tuple[tuple[str, int], ...]
    """Reason and number, the most frequent first."""
    undecided: int


def read_decisions(root: Path) -> list[Decision]:
    """Every decision of a dataset, in the order in which they were made.

    Raises:
        ScenarioError: names the file and the line's candidate.
    """
    finish_update(root)
    path = root / FOLDER / DECISIONS_FILE
    return _decisions(path, read_journal(path, SCHEMA_VERSION))


def _decisions(path: Path, records: Iterable[dict[str, Any]]) -> list[Decision]:
    decisions = []
    for record in records:
        try:
            decision = Decision(**{k: v for k, v in record.items() if k != "schema"})
        except TypeError as err:
            raise ScenarioError(f"{path}: {err}; it was not written by this package") from None
        good = decision.stage in STAGES and decision.verdict in ("kept", "dropped", "undecided")
        if not good or not all(isinstance(value, str) for value in vars(decision).values()):
            raise ScenarioError(f"{path}: {record!r:.200} is not a decision of a stage on a candidate")
        decisions.append(decision)
    return decisions


def record_decisions(root: Path, decisions: Iterable[Decision]) -> int:
    """Adds those decisions that say something new.

    Args:
        root: the dataset's folder.
        decisions: verdicts; one that is what the stage said last is left out, so that a stage which runs
            again does not fill the file.

    Returns:
        The number added.
    """
    finish_update(root)
    path = root / FOLDER / DECISIONS_FILE
    with Journal(path, SCHEMA_VERSION) as journal:
        last = {(d.stage, d.candidate): d for d in _decisions(path, journal.records)}
        new = []
        for decision in decisions:
            before = last.get((decision.stage, decision.candidate))
            if before is None or _said(before) != _said(decision):
                at = decision.at or datetime.now(UTC).isoformat(timespec="seconds")
                new.append({**asdict(decision), "at": at})
                last[decision.stage, decision.candidate] = decision
        journal.append(*new)
    return len(new)


def carry_decisions(source: Path, target: Path) -> None:
    """Copies the decisions so far into the dataset that a stage has made."""
    finish_update(source)
    path = source / FOLDER / DECISIONS_FILE
    if path.is_file():
        with atomic_file(target / FOLDER / DECISIONS_FILE) as copy:
            shutil.copyfile(path, copy)


def survivors(decisions: Sequence[Decision], stage: StageName) -> set[str]:
    """Candidates that a stage and every stage before it kept, as far as those decided."""
    found = {d.candidate for d in decisions}
    for decided, _, kept, _ in _walk(decisions):
        if STAGES.index(decided) > STAGES.index(stage):
            break
        found = kept
    return found


def count_stages(decisions: Sequence[Decision]) -> list[StageCounts]:
    """Counts by stage; a stage enters what the stage before kept."""
    rows = []
    for stage, entered, kept, last in _walk(decisions):
        dropped = Counter(
            last[c].reason or "no reason given" for c in entered if c in last and last[c].verdict == "dropped"
        )
        rows.append(
            StageCounts(
                stage=stage,
                entered=len(entered),
                kept=len(kept),
                dropped=tuple(sorted(dropped.items(), key=lambda item: (-item[1], item[0]))),
                undecided=len(entered) - len(kept) - dropped.total(),
            )
        )
    return rows


def attrition_table(rows: Sequence[StageCounts]) -> str:
    """The table as text, one line a stage and one a reason."""
    cells: list[tuple[object, ...]] = [("stage", "entered", "kept", "undecided", "dropped", "")]
    for row in rows:
        dropped = sum(n for _, n in row.dropped)
        cells.append((row.stage, row.entered, row.kept, row.undecided, dropped, ""))
        cells += [("", "", "", "", n, reason) for reason, n in row.dropped]
    return "\n".join(align(cells, left=(0, 5)))


def _said(decision: Decision) -> tuple[str, str, str]:
    return decision.verdict, decision.reason, decision.detail


def _walk(
    decisions: Sequence[Decision],
) -> Iterable[tuple[str, set[str], set[str], dict[str, Decision]]]:
    """For each stage that decided anything: its name, what entered, what it kept, its last decisions."""
    entered: set[str] | None = None
    for stage in STAGES:
        last = {d.candidate: d for d in decisions if d.stage == stage}
        if not last:
            continue
        if entered is None:
            entered = {d.candidate for d in decisions}
        kept = {c for c in entered if c in last and last[c].verdict == "kept"}
        yield stage, entered, kept, last
        entered = kept
