"""What the page is told of an episode: all that may be shown, in words for people.

Not who drove, nor what others marked, nor the candidate's own id (`identity.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_roborecover.curation.annotation.naming import body_labels, hand_label
from lerobot_roborecover.curation.annotation.traces import Place, action_labels, suggest, traces
from lerobot_roborecover.curation.annotation.votes import Ballot, Vote
from lerobot_roborecover.curation.candidates import CandidateSet
from lerobot_roborecover.recording import Steps
from lerobot_roborecover.scenario import Source

MAX_BODIES_PLOTTED = 4


def first_step(candidates: CandidateSet, episode: int) -> int:
    """The first step at which a recovery point may be: after the settling actions and at least one more."""
    reset = candidates.row(episode).reset_record()
    return (reset.settle_steps if reset else 0) + 1


def sheet(
    candidates: CandidateSet,
    number: int,
    name: str,
    fps: float,
    ballot: Ballot,
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
    steps, actions = candidates.steps(number), candidates.actions(number)
    first = first_step(candidates, number)
    plotted = traces(candidates.platform, actions, steps, fps, first - 1)
    called = action_labels(candidates.platform, actions.shape[1])
    bodies = labels_of(steps)
    objects = dict(list(plotted.object_speed_m_s.items())[:MAX_BODIES_PLOTTED])
    vote = ballot.votes.get(candidate.id)
    found = None
    if vote is not None and candidate.id in ballot.revealed:
        own = suggest(steps, fps, first, bodies)
        found = [
            {"step": s.step, "text": " ".join(filter(None, (s.stage, s.deviation, s.reason))), "by": s.by}
            for s in (*candidate.suggestions, *own)
        ]
    return {
        "id": name,
        "instruction": row.task["instruction"],
        "task": f"{row.task['suite']} / {row.task['name']}",
        "human": candidate.source is Source.HUMAN,
        "steps": row.steps,
        "first_step": first,
        "solved_at_end": bool(steps.solved[-1]),
        "actions": {called[n]: _rounded(v) for n, v in plotted.actions.items()},
        "gripper": {called[n]: _rounded(v) for n, v in plotted.gripper.items()},
        "eef_speed": _rounded(plotted.eef_speed_m_s),
        "object_speed": {bodies[n]: _rounded(v) for n, v in objects.items()},
        "places": {bodies[n]: _place_json(p) for n, p in plotted.places.items()},
        "vote": vote_json(vote, name),
        "suggestions": found,
        "discussion": None if discussed is None else dict(discussed),
    }


def labels_of(steps: Steps) -> dict[str, str]:
    """What a rollout's bodies are called, by name."""
    hands = {n: hand_label(n) for n in steps.bodies if n.startswith("eef")}
    return hands | body_labels(n for n in steps.bodies if n not in hands)


def vote_json(vote: Vote | None, name: str) -> dict[str, Any] | None:
    """A vote as the page takes it, on the episode of that name."""
    if vote is None:
        return None
    shown = ("uid", "verdict", "step", "stage", "deviation", "reason", "comment", "seconds")
    return {"candidate": name, **{field: getattr(vote, field) for field in shown}}


def _place_json(place: Place) -> dict[str, list[float] | None]:
    values = {"reach": place.reach_m, "goal": place.goal_m, "moved": place.moved_m, "height": place.height_m}
    return {name: None if v is None else _rounded(v) for name, v in values.items()}


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 4) for v in values]
