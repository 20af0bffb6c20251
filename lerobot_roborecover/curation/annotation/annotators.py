"""The three automatic annotators: the same rules, other thresholds, and other frames that they look at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

PREFIX = "auto-"
"""Prefix of every automatic annotator's name; no person's name begins with it."""


@dataclass(frozen=True)
class LabelerThresholds:
    """How one annotator looks and where it draws the line; metres and seconds."""

    first_look: float = 0.0
    """When it first looks, as a share of the time from one look to the next."""
    contact_m: float = 0.10
    """The hand is at the object within this, and has to approach it beyond."""
    place_m: float = 0.10
    """The object is at its place within this."""
    knocked_m: float = 0.04
    """An object pushed sideways by more has changed the scene."""
    carried_m: float = 0.02
    """An object that went this far with the hand was in the grasp."""
    lost_m: float = 0.05
    """An object that was carried and is farther from the hand than this is lost."""
    rest_m: float = 0.01
    """An object that moves less than this within `rest_s` lies still, or is as good as still."""
    rest_s: float = 0.15
    stuck_m: float = 0.015
    """The hand is stuck where its distance to every object changes by less from `stuck_s` before to `stuck_s`
    after."""
    stuck_s: float = 0.25
    event_m: float = 0.05
    """Half of this nearer to the goal is progress; where no goal is known, an object that moves by more than
    this later was not final where it was."""
    stable_s: float = 0.5
    """How long a deviation has to last."""


LABELERS: Mapping[str, LabelerThresholds] = {
    "auto-1": LabelerThresholds(),
    "auto-2": LabelerThresholds(
        first_look=0.3, contact_m=0.09, place_m=0.09, knocked_m=0.035, lost_m=0.045, stuck_m=0.018,
        event_m=0.04,
    ),
    "auto-3": LabelerThresholds(
        first_look=0.6, contact_m=0.11, place_m=0.12, knocked_m=0.05, carried_m=0.03, lost_m=0.06,
        stuck_m=0.012, event_m=0.06, stable_s=0.4,
    ),
}  # fmt: skip
"""By name."""


def is_automatic(annotator: str) -> bool:
    """Whether a name is an automatic annotator's."""
    return annotator.startswith(PREFIX)


def label_kind(annotators: Iterable[str]) -> Literal["people", "automatic", "mixed"]:
    """Whose labels come from these annotators' votes."""
    kinds = {is_automatic(name) for name in annotators}
    if len(kinds) > 1:
        return "mixed"
    return "automatic" if True in kinds else "people"
