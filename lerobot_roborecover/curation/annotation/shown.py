"""What annotators are shown of an episode, people by the page and programs as numbers: series of one value a
frame, under names for people. And which votes on it are taken."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from lerobot_roborecover.curation.annotation.naming import body_labels, hand_label
from lerobot_roborecover.curation.annotation.traces import Place, action_labels, traces
from lerobot_roborecover.curation.annotation.votes import Vote, VoteJournal, parse_vote
from lerobot_roborecover.curation.candidates import CandidateSet
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.scenario import Source

MAX_BODIES_PLOTTED = 4

type Series = list[float]
"""One value a frame, to 4 decimals."""


@dataclass(frozen=True)
class Shown:
    """An episode of T frames in numbers; by the names that people read."""

    instruction: str
    steps: int
    """T."""
    first_step: int
    """The first step at which a recovery point may be."""
    human: bool
    """A person caused the deviation and corrected it."""
    solved: bool
    """At the end."""
    actions: Mapping[str, Series]
    """As they were commanded, gripper left out."""
    gripper: Mapping[str, Series]
    """Commanded; empty where the platform has none."""
    eef_speed: Series
    """Metres a second, of the fastest end effector."""
    object_speed: Mapping[str, Series]
    """Metres a second, of those that move most."""
    places: Mapping[str, Mapping[str, Series | None]]
    """By object, in the order of `Traces.places`: `reach`, `goal`, `moved` and `height` in metres (`Place`);
    the goal is None where the recording knows of none."""


def shown(candidates: CandidateSet, number: int, fps: float) -> Shown:
    """Returns the part of an episode that annotators see.

    Args:
        candidates: the dataset.
        number: of the episode in it.
        fps: frames a second.

    Raises:
        ScenarioError: its steps or actions cannot be read.
    """
    row, steps, actions = candidates.row(number), candidates.steps(number), candidates.actions(number)
    first = first_step(candidates, number)
    plotted = traces(candidates.platform, actions, steps, fps, first - 1)
    called = action_labels(candidates.platform, actions.shape[1])
    bodies = labels_of(steps)
    objects = list(plotted.object_speed_m_s.items())[:MAX_BODIES_PLOTTED]
    return Shown(
        instruction=row.task["instruction"],
        steps=row.steps,
        first_step=first,
        human=_human(candidates, number),
        solved=bool(steps.solved[-1]),
        actions={called[n]: _rounded(v) for n, v in plotted.actions.items()},
        gripper={called[n]: _rounded(v) for n, v in plotted.gripper.items()},
        eef_speed=_rounded(plotted.eef_speed_m_s),
        object_speed={bodies[n]: _rounded(v) for n, v in objects},
        places={bodies[n]: _place(p) for n, p in plotted.places.items()},
    )


def first_step(candidates: CandidateSet, episode: int) -> int:
    """The first step at which a recovery point may be: after the settling actions and at least one more."""
    reset = candidates.row(episode).reset_record()
    return (reset.settle_steps if reset else 0) + 1


def labels_of(steps: Steps) -> dict[str, str]:
    """Returns the display name of each of a rollout's bodies."""
    hands = {n: hand_label(n) for n in steps.bodies if n.startswith("eef")}
    return hands | body_labels(n for n in steps.bodies if n not in hands)


def take_vote(book: VoteJournal, candidates: CandidateSet, candidate: str, sent: object) -> Vote:
    """Checks a vote and takes it; it is on disk when this returns.

    Args:
        book: the annotator's.
        candidates: the dataset.
        candidate: the candidate's id, which `sent` may name differently.
        sent: see `parse_vote`.

    Raises:
        VoteError: names the field, the value and what it may be.
        ScenarioError: it could not be written.
    """
    number = candidates.by_id[candidate]
    vote = parse_vote(
        sent,
        first_step=first_step(candidates, number),
        steps=candidates.row(number).steps,
        human=_human(candidates, number),
    )
    return book.add(replace(vote, candidate=candidate))


def _human(candidates: CandidateSet, number: int) -> bool:
    return candidates.candidates[number].source is Source.HUMAN


def _place(place: Place) -> dict[str, Series | None]:
    values = {"reach": place.reach_m, "goal": place.goal_m, "moved": place.moved_m, "height": place.height_m}
    return {name: None if v is None else _rounded(v) for name, v in values.items()}


def _rounded(values: Iterable[float]) -> Series:
    return [round(float(v), 4) for v in values]
