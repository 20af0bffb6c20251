"""Automatic annotators at work: they apply their rules to the recorded steps, and vote.

They see the numbers that the page prints beside its frames, with its digits: at the page they vote the same
(`tests/web/test_automatic_at_the_page.py`). What has a vote already is left out, so that a run that was
stopped goes on.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from decimal import ROUND_HALF_UP, Decimal
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_roborecover.curation.annotation.annotators import LABELERS, LabelerThresholds
from lerobot_roborecover.curation.annotation.features import (
    HAND,
    EpisodeFeatures,
    EpisodeInfo,
    Reading,
    frames_to_look_at,
)
from lerobot_roborecover.curation.annotation.frames import Videos
from lerobot_roborecover.curation.annotation.rules import Verdict, judge
from lerobot_roborecover.curation.annotation.shown import Shown, shown, take_vote
from lerobot_roborecover.curation.annotation.votes import VoteError, VoteJournal, votes_folder
from lerobot_roborecover.curation.candidates import CandidateSet, read_candidates
from lerobot_roborecover.curation.resolution import to_vote_on
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError

NUMBER_DIGITS, TIME_DIGITS = 3, 2
"""Decimals of the page's numbers and of its times."""
_SAY_EVERY = 20

type Say = Callable[[str], None]


def annotate(
    dataset: Path,
    say: Say,
    *,
    annotators: Sequence[str] = tuple(LABELERS),
    votes: Path | None = None,
    only: Path | None = None,
) -> None:
    """Has every candidate voted on by automatic annotators.

    Args:
        dataset: a candidate dataset.
        say: called with the progress.
        annotators: names of `LABELERS`.
        votes: folder of all votes; by default inside the dataset.
        only: a list of candidates to discuss (`roborecover curate agree --discuss`).

    Raises:
        ScenarioError: a name is none of them, something cannot be read or written, or an annotator is at work
            elsewhere.
    """
    unknown = [name for name in annotators if name not in LABELERS]
    if unknown:
        raise ScenarioError(
            f"there is no automatic annotator {unknown[0]!r:.80}; there are {', '.join(LABELERS)}"
        )
    candidates = read_candidates(dataset)
    fps = Videos(dataset, needed=False).fps
    wanted, discussion = to_vote_on(candidates, only)
    folder, number = votes_folder(dataset, votes), discussion.round if discussion else 1
    for name in annotators:
        with closing(VoteJournal(folder, name, number)) as book:
            _vote_on_all(book, candidates, wanted, fps, say)


def _vote_on_all(book: VoteJournal, candidates: CandidateSet, wanted: set[str], fps: float, say: Say) -> None:
    """One annotator, in the order of the dataset."""
    name, done = book.annotator, book.ballot().votes
    commands = platform_named(candidates.platform).gripper_commands
    left = [c.id for c in candidates.candidates if c.id in wanted and c.id not in done]
    began = time.monotonic()
    outcomes: Counter[str] = Counter()
    for number, candidate in enumerate(left, 1):
        since = time.monotonic()
        episode = shown(candidates, candidates.by_id[candidate], fps)
        sheet = sheet_of(candidate, episode, fps, commands)
        verdict = verdict_on(sheet, partial(reading, episode), LABELERS[name])
        vote = _entered(verdict, episode.first_step)
        seconds = round(time.monotonic() - since)
        try:
            take_vote(book, candidates, candidate, {"uid": str(uuid.uuid4()), "seconds": seconds, **vote})
        except VoteError as err:
            raise ScenarioError(f"candidate {candidate}: the vote of {name} cannot be taken: {err}") from None
        outcomes[verdict.discard or f"{verdict.stage}-{verdict.deviation}"] += 1
        if number % _SAY_EVERY == 0 or number == len(left):
            each = (time.monotonic() - began) / number
            say(f"{name}: {number} of {len(left)}, {each:.2f} s an episode")
    say(f"{name}: " + (", ".join(f"{n} {what}" for what, n in outcomes.most_common()) or "nothing to do"))


def verdict_on(sheet: EpisodeInfo, read: Callable[[int], Reading], eye: LabelerThresholds) -> Verdict:
    """The verdict on an episode: looks along it, then closer before the point, frame by frame.

    Args:
        sheet: of the episode.
        read: gives a frame's numbers.
        eye: whose.
    """
    look = EpisodeFeatures(sheet)
    for frame in frames_to_look_at(eye.first_look, sheet.fps, sheet.last):
        look.readings[frame] = read(frame)
    verdict = judge(look, eye)
    if verdict.step is None:
        return verdict
    before = [f for f in look.readings if f < verdict.step]
    for frame in range(verdict.step - 1, max(before, default=0), -1):
        look.readings[frame] = read(frame)
    return judge(look, eye)


def sheet_of(
    candidate: str, episode: Shown, fps: float, gripper_commands: tuple[float, float] = (-1.0, 1.0)
) -> EpisodeInfo:
    """An episode as a whole. Its rate is that of the times which the page prints.

    Args:
        candidate: id.
        episode: what is shown of it.
        fps: frames a second, as recorded.
        gripper_commands: values that open and close a gripper (`Platform`).
    """
    last = episode.steps - 1
    seconds = as_printed(last / fps, TIME_DIGITS)
    rate = last / seconds if seconds else 1.0
    return EpisodeInfo(
        candidate, episode.instruction, last, rate, episode.solved, episode.human, gripper_commands
    )


def reading(episode: Shown, frame: int) -> Reading:
    """The numbers of a frame, as the page prints them."""
    rows = {HAND: {"speed": episode.eef_speed, **episode.gripper}}
    for name, place in episode.places.items():
        speed = {"speed": episode.object_speed[name]} if name in episode.object_speed else {}
        rows[name] = {**speed, **{key: values for key, values in place.items() if values is not None}}
    return {
        name: {key: as_printed(values[frame], NUMBER_DIGITS) for key, values in row.items()}
        for name, row in rows.items()
    }


def as_printed(value: float, digits: int) -> float:
    """A number as JavaScript's `toFixed` prints it: rounded as the exact binary number that it is, and a half
    away from zero (Python's own formats go to the even digit)."""
    return float(Decimal(value).quantize(Decimal(1).scaleb(-digits), ROUND_HALF_UP))


def _entered(verdict: Verdict, first_step: int) -> dict[str, Any]:
    """What is marked; before the first step at which a point may be, nothing was done."""
    if verdict.discard:
        return {"verdict": "discard", "reason": verdict.discard}
    assert verdict.step is not None
    assert verdict.stage is not None
    assert verdict.deviation is not None
    return {
        "verdict": "recovery",
        "step": max(verdict.step, first_step),
        "stage": verdict.stage.value,
        "deviation": verdict.deviation.value,
    }
