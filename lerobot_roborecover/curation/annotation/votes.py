"""Votes: one annotator's marks, appended to a journal of their own, and what they amount to.

Nothing is ever overwritten. A later vote on a candidate takes the place of an earlier one, an `undo` takes
the latest vote back, and a `reveal` says that the annotator has seen the suggestions for a candidate, so that
a vote after it is known not to be blind.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.scenario import DeviationType, ScenarioError, Stage
from lerobot_roborecover.utils.journal import Journal, read_journal

VOTES_FOLDER = "votes"
SCHEMA_VERSION = 1
MAX_COMMENT_CHARS = 2000

DISCARD_REASONS: dict[str, str] = {
    "temporary": "Recovers by itself: later actions bring the task back on its way",
    "no_deviation": "Nothing goes wrong",
    "erratic": "Erratic motion, or out of the workspace",
    "irreversible": "Task damaged for good, e.g. an object fell off the table",
    "stuck": "The robot can no longer interact properly",
    "not_still": "On a real robot: never at rest, so that a hand could put it back",
    "unclear": "Cannot be decided from the video",
    "other": "Something else: say it in the comment",
}
"""Why a trajectory yields no scenario (paper, "Natural Scenarios" and "Stage-Type and Recovery Point
Annotation")."""

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
_UID = re.compile(r"[A-Za-z0-9-]{8,64}")


class VoteError(RoboRecoverError, ValueError):
    """A vote cannot be taken; the message says which field, the value and what it may be."""


@dataclass(frozen=True)
class Vote:
    """One annotator's verdict on one candidate."""

    uid: str
    """Made by the page: a vote that is sent twice, because an answer was lost, counts once."""
    candidate: str
    verdict: Literal["recovery", "discard"]
    step: int | None = None
    """Recovery point: the frame that shows it, and the number of actions before it."""
    stage: str = ""
    deviation: str = ""
    reason: str = ""
    """Reason of a discard: a key of `DISCARD_REASONS`."""
    comment: str = ""
    seconds: float = 0.0
    """Time spent on the candidate, as the page measured it."""
    annotator: str = ""
    round: int = 1
    """1 is the blind pass; later ones are discussions of what it did not settle."""
    informed: bool = False
    """The annotator had seen suggestions for this candidate."""
    at: str = ""
    """UTC, ISO 8601."""


def votes_folder(dataset: Path, votes: Path | None) -> Path:
    """Where a dataset's votes are."""
    return dataset / FOLDER / VOTES_FOLDER if votes is None else votes


def check_name(name: str) -> str:
    """An annotator's name, as it is used for a file and in an address.

    Raises:
        ScenarioError: it is not plain.
    """
    if not _NAME.fullmatch(name):
        raise ScenarioError(
            f"annotator {name[:80]!r} is not 1 to 32 of a-z, 0-9, '_' and '-', starting with one of the "
            "first two kinds"
        )
    return name


def parse_vote(sent: object, *, first_step: int, steps: int, human: bool) -> Vote:
    """A vote as the page sends it, checked against the candidate's rollout.

    Args:
        sent: decoded JSON.
        first_step: the first step at which a recovery point may be.
        steps: T of the rollout; frames are 0 to T - 1.
        human: the rollout is human-made, so that a later correction is its proof and no reason to discard it.

    Raises:
        VoteError: names the field, the value and what it may be.
    """
    known = {"uid", "candidate", "verdict", "step", "stage", "deviation", "reason", "comment", "seconds"}
    if not isinstance(sent, dict) or not set(sent) <= known:
        raise VoteError(f"a vote is an object with the fields {', '.join(sorted(known))}")
    fields: dict[str, Any] = {"uid": "", "candidate": "", "verdict": "", **sent}
    vote = Vote(**fields)
    _need(
        isinstance(vote.uid, str) and _UID.fullmatch(vote.uid), "uid", vote.uid, "8 to 64 letters and digits"
    )
    _need(
        isinstance(vote.comment, str) and len(vote.comment) <= MAX_COMMENT_CHARS and _encodable(vote.comment),
        "comment", vote.comment, f"text of at most {MAX_COMMENT_CHARS} characters",
    )  # fmt: skip
    _need(
        type(vote.seconds) in (int, float) and 0 <= vote.seconds < 1e6, "seconds", vote.seconds, "a duration"
    )
    last = steps - 1
    in_range = type(vote.step) is int and first_step <= vote.step <= last
    if vote.verdict == "recovery":
        _need(in_range, "step", vote.step, f"a step from {first_step} to {last}")
        _need(vote.stage in tuple(Stage), "stage", vote.stage, f"one of {', '.join(Stage)}")
        _need(
            vote.deviation in tuple(DeviationType), "deviation", vote.deviation,
            f"one of {', '.join(DeviationType)}",
        )  # fmt: skip
        _need(vote.reason == "", "reason", vote.reason, "empty where the trajectory is kept")
    elif vote.verdict == "discard":
        _need(
            isinstance(vote.reason, str) and vote.reason in DISCARD_REASONS, "reason", vote.reason,
            f"one of {', '.join(DISCARD_REASONS)}",
        )  # fmt: skip
        _need(
            not (human and vote.reason == "temporary"), "reason", vote.reason,
            "another one: in a human-made trajectory the later correction proves that it can be recovered",
        )  # fmt: skip
        _need(vote.reason != "other" or vote.comment.strip(), "comment", vote.comment, "the reason in words")
        _need(vote.step is None or in_range, "step", vote.step, f"none, or {first_step} to {last}")
        _need(vote.stage == "" == vote.deviation, "stage", vote.stage, "empty where it is discarded")
    else:
        raise VoteError(f"field verdict: {vote.verdict!r:.80} is not 'recovery' or 'discard'")
    return replace(vote, seconds=float(vote.seconds))


def _need(good: object, field: str, value: object, wanted: str) -> None:
    if not good:
        raise VoteError(f"field {field}: {value!r:.80} is not {wanted}")


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


@dataclass(frozen=True)
class CurrentVotes:
    """An annotator's current votes in one round, from the journal."""

    votes: Mapping[str, Vote]
    """By candidate: the latest that stands."""
    blind: Mapping[str, Vote]
    """By candidate: the latest that stands and was made without having seen suggestions."""
    revealed: frozenset[str]
    """Candidates whose suggestions the annotator has seen."""
    order: tuple[str, ...]
    """uids of the votes that stand, in the order in which they were made."""


def ballot(records: Iterable[Mapping[str, Any]], round_number: int | None) -> CurrentVotes:
    """Folds a journal; of no round where there is no number.

    Raises:
        ScenarioError: a record is none of an annotator's.
    """
    standing: list[Vote] = []
    revealed: set[str] = set()
    for record in records:
        try:
            if record["kind"] == "vote":
                vote = _read_vote(record)
                if vote.round == round_number:
                    standing.append(vote)
            elif record["kind"] == "undo":
                if record["round"] == round_number:
                    standing = [v for v in standing if v.uid != record["uid"]]
            elif record["kind"] == "reveal":
                revealed.add(str(record["candidate"]))
            else:
                raise KeyError(record["kind"])
        except (KeyError, TypeError, ValueError) as err:
            raise ScenarioError(
                f"{dict(record)!r:.200} is not an annotator's record ({err!r:.100})"
            ) from None
    return CurrentVotes(
        {v.candidate: v for v in standing},
        {v.candidate: v for v in standing if not v.informed},
        frozenset(revealed),
        tuple(v.uid for v in standing),
    )


def _read_vote(record: Mapping[str, Any]) -> Vote:
    vote = Vote(**{f.name: record[f.name] for f in fields(Vote)})
    labels = vote.stage in ("", *Stage) and vote.deviation in ("", *DeviationType)
    whole = vote.verdict == "discard" or (bool(vote.stage) and bool(vote.deviation) and vote.step is not None)
    texts = (vote.uid, vote.candidate, vote.annotator, vote.reason, vote.comment)
    if vote.verdict not in ("recovery", "discard") or not (labels and whole) or type(vote.round) is not int:
        raise ValueError("not a vote")
    if not all(isinstance(t, str) for t in texts) or type(vote.step) not in (int, type(None)):
        raise ValueError("not a vote")
    return vote


class VoteJournal:
    """One annotator's open journal; only one process may hold it. Safe to use from several threads.

    Args:
        folder: of all annotators' votes.
        annotator: whose.
        round_number: of this session.

    Raises:
        ScenarioError: the journal is damaged, or open elsewhere.
    """

    def __init__(self, folder: Path, annotator: str, round_number: int):
        self.annotator, self.round = check_name(annotator), round_number
        self._journal = Journal(folder / f"{annotator}.jsonl", SCHEMA_VERSION)
        self._lock = threading.Lock()
        self._ballot = ballot(self._journal.records, round_number)

    def ballot(self) -> CurrentVotes:
        return self._ballot

    def add(self, vote: Vote) -> Vote:
        """Takes a vote; it is on disk when this returns. One with a known uid is answered, not added
        again."""
        with self._lock:
            for record in self._journal.records:
                if record["kind"] == "vote" and record["uid"] == vote.uid:
                    return _read_vote(record)
            whole = replace(
                vote,
                annotator=self.annotator,
                round=self.round,
                informed=vote.candidate in self._ballot.revealed,
                at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            )
            self._append({"kind": "vote", **asdict(whole)})
            return whole

    def undo(self, uid: str) -> Vote | None:
        """Takes the latest vote back, if it still is the one meant; a repeated undo changes nothing.

        Args:
            uid: of the vote that the page shows as the latest.

        Returns:
            The vote taken back, or None where another one is the latest.
        """
        with self._lock:
            if not self._ballot.order or self._ballot.order[-1] != uid:
                return None
            record = next(r for r in self._journal.records if r["kind"] == "vote" and r["uid"] == uid)
            self._append({"kind": "undo", "uid": uid, "round": self.round})
            return _read_vote(record)

    def reveal(self, candidate: str) -> None:
        """Notes that the annotator has seen the suggestions for a candidate."""
        with self._lock:
            if candidate not in self._ballot.revealed:
                self._append({"kind": "reveal", "candidate": candidate, "round": self.round})

    def close(self) -> None:
        self._journal.close()

    def _append(self, record: Mapping[str, Any]) -> None:
        self._journal.append(record)
        self._ballot = ballot(self._journal.records, self.round)


def read_votes(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Every annotator's records, by name.

    Raises:
        ScenarioError: there are none, or a journal is damaged.
    """
    paths = sorted(folder.glob("*.jsonl")) if folder.is_dir() else []
    found = {check_name(p.stem): read_journal(p, SCHEMA_VERSION) for p in paths}
    if not any(found.values()):
        raise ScenarioError(f"{folder} holds no votes; collect some with `roborecover curate annotate`")
    return found
