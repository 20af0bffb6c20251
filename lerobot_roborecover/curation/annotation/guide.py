"""What annotators are told: the definitions of the paper's problem formulation, and one line a cell.

All annotators work from this one guide. Its example frames come from `examples.py`.
"""

from __future__ import annotations

from lerobot_roborecover.curation.annotation.votes import DISCARD_REASONS
from lerobot_roborecover.scenario import DeviationType, Stage

RECOVERY_POINT = (
    "The recovery point is the step at which a deviation is present and stable: what follows stays stuck in "
    "it. It is usually neither the first unusual frame nor the last frame of the failed episode. Where "
    "several deviations follow each other, take the last one.",
    "If later actions bring the task back on its way, the deviation was temporary: discard it, unless the "
    "trajectory is human-made, where the correction proves that the state can be recovered.",
    "The instruction must still make sense from there, and a good policy must be able to finish the task. "
    "Discard the trajectory if the damage is for good or the robot can no longer interact properly.",
)

STAGES: dict[Stage, tuple[str, str]] = {
    Stage.APPROACH: ("a", "The robot has to approach the right object or region again."),
    Stage.CONTACT: ("c", "It is there, and has to get an effective contact or grasp again."),
    Stage.MOVE: ("m", "It has the object, and has to go on carrying or moving it properly."),
    Stage.PLACE: ("p", "The object is handled well, and has to be brought to where it belongs."),
}
"""By stage: key and what has to be resumed."""

TYPES: dict[DeviationType, tuple[str, str]] = {
    DeviationType.WRONG_TARGET: ("1", "It is interacting with the wrong object or the wrong goal."),
    DeviationType.WRONG_POSE: ("2", "Robot and object are in a spatial relation that does not work."),
    DeviationType.STAGE_ROLLBACK: ("3", "A contact, a grasp or progress that was there is lost."),
    DeviationType.SCENE_CHANGE: (
        "4",
        "What it did has changed the scene, and going on as before cannot work.",
    ),
}
"""By deviation type: key and what prevents normal interaction."""

CELLS: dict[tuple[Stage, DeviationType], str] = {
    (Stage.APPROACH, DeviationType.WRONG_TARGET): "Turn away from the wrong object and go to the right one.",
    (Stage.APPROACH, DeviationType.WRONG_POSE): "Come to the object from a better side before touching it.",
    (Stage.APPROACH, DeviationType.STAGE_ROLLBACK): "Go back to the object that was lost, and begin again.",
    (Stage.APPROACH, DeviationType.SCENE_CHANGE): "Look where the object is now, and approach it there.",
    (Stage.CONTACT, DeviationType.WRONG_POSE): "Touch or grasp again: the present hold does not work.",
    (Stage.MOVE, DeviationType.WRONG_POSE): "Correct hand or object before carrying on with the transport.",
    (Stage.PLACE, DeviationType.WRONG_TARGET): "Take the object from the wrong place to the one asked for.",
    (Stage.PLACE, DeviationType.WRONG_POSE): "Line object and goal up before letting go.",
    (Stage.PLACE, DeviationType.SCENE_CHANGE): "The goal has changed: look again before placing.",
}
"""The nine cells that the paper's test sets occupy. Others may be marked."""


def slug(stage: Stage, deviation: DeviationType) -> str:
    """A cell's name in addresses and files, e.g. `approach-wrong-pose`."""
    return f"{stage.value}-{deviation.value}".lower().replace(" ", "-")


SLUGS = tuple(slug(*cell) for cell in CELLS)


def as_json() -> dict:
    """The guide as the page takes it."""
    return {
        "recovery_point": RECOVERY_POINT,
        "stages": [{"name": s.value, "key": key, "text": text} for s, (key, text) in STAGES.items()],
        "types": [{"name": d.value, "key": key, "text": text} for d, (key, text) in TYPES.items()],
        "reasons": [{"name": name, "text": text} for name, text in DISCARD_REASONS.items()],
        "cells": [
            {"stage": s.value, "type": d.value, "slug": slug(s, d), "text": text}
            for (s, d), text in CELLS.items()
        ],
    }
