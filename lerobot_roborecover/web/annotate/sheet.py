"""What the page is told of an episode: all that may be shown, in words for people.

Not the controller, nor what others marked, nor the candidate's own id (`identity.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.curation.annotation.shown import labels_of, shown
from lerobot_roborecover.curation.annotation.traces import suggest
from lerobot_roborecover.curation.annotation.votes import CurrentVotes, Vote
from lerobot_roborecover.curation.candidates import CandidateSet


def sheet(
    candidates: CandidateSet,
    number: int,
    name: str,
    fps: float,
    ballot: CurrentVotes,
    discussed: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """An episode as the page takes it.

    Args:
        candidates: the dataset.
        number: of the episode in it.
        name: what annotators call it.
        fps: frames a second.
        ballot: the annotator's.
        discussed: the votes so far, in a discussion.
    """
    row, candidate = candidates.row(number), candidates.candidates[number]
    numbers = shown(candidates, number, fps)
    vote = ballot.votes.get(candidate.id)
    found = None
    if vote is not None and candidate.id in ballot.revealed:
        steps = candidates.steps(number)
        own = suggest(steps, fps, numbers.first_step, labels_of(steps))
        found = [
            {"step": s.step, "text": " ".join(filter(None, (s.stage, s.deviation, s.reason))), "by": s.by}
            for s in (*candidate.suggestions, *own)
        ]
    return {
        "id": name,
        "instruction": numbers.instruction,
        "task": f"{row.task['suite']} / {row.task['name']}",
        "human": numbers.human,
        "steps": numbers.steps,
        "first_step": numbers.first_step,
        "solved_at_end": numbers.solved,
        "actions": numbers.actions,
        "gripper": numbers.gripper,
        "eef_speed": numbers.eef_speed,
        "object_speed": numbers.object_speed,
        "places": numbers.places,
        "vote": vote_json(vote, name),
        "suggestions": found,
        "discussion": None if discussed is None else dict(discussed),
    }


def vote_json(vote: Vote | None, name: str) -> dict[str, Any] | None:
    """A vote as the page takes it, on the episode of that name."""
    if vote is None:
        return None
    fields = ("uid", "verdict", "step", "stage", "deviation", "reason", "comment", "seconds")
    return {"candidate": name, **{field: getattr(vote, field) for field in fields}}
