"""What is plotted below the frames: actions, gripper, speeds, and where the objects are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.curation.candidates import Suggestion
from lerobot_roborecover.platforms import platform_named, platform_names
from lerobot_roborecover.platforms.simulator import GOAL, GOAL_OF, HANDLE, is_mark
from lerobot_roborecover.replay.recorder import Steps

MOVING_M_S = 0.02
"""An object faster than this moves; below lie settling and contact noise."""
REST_S = 0.25
"""An object that moves again within this time has not come to rest."""
STUCK_M, STUCK_S = 0.015, 1.0
"""The end effector is stuck where it stays within this distance for this long, to the end."""


MAX_PLACES = 4
"""Objects whose place is shown, at most."""


@dataclass(frozen=True)
class Place:
    """Where one object is, (T,) metres each."""

    reach_m: np.ndarray
    """From the nearest end effector."""
    goal_m: np.ndarray | None
    """From where the task wants it, where the recording says so."""
    moved_m: np.ndarray
    """From where it was when the rollout began."""
    height_m: np.ndarray
    """Above where it was then."""


@dataclass(frozen=True)
class Traces:
    """Plots of one rollout of T frames, one value a frame."""

    actions: dict[str, np.ndarray]
    """(T,) by name, gripper left out."""
    gripper: dict[str, np.ndarray]
    """(T,) commanded, by name; empty where the platform has none."""
    eef_speed_m_s: np.ndarray
    """(T,) of the fastest end effector."""
    object_speed_m_s: dict[str, np.ndarray]
    """(T,) by object, those that are ever moved, the one that moves farthest first; 0 while settling."""
    places: dict[str, Place]
    """By object: the one with a goal, then those that are moved, then whatever the hand came nearest to."""


def traces(platform: str, actions: np.ndarray, steps: Steps, fps: float, settle_steps: int = 0) -> Traces:
    """Traces of a rollout.

    Args:
        platform: decides which actions are grippers.
        actions: (T, A) float64.
        steps: T + 1 states.
        fps: frames a second.
        settle_steps: leading actions that only let the scene settle: objects that drop into place then have
            not been moved, and would dwarf what comes later.
    """
    width = actions.shape[1]
    grippers = platform_named(platform).grippers(width)
    eef = {n: poses[:, :3] for n, poses in steps.bodies.items() if n.startswith("eef")}
    objects = positions(steps)
    later = np.arange(len(actions)) >= settle_steps
    speeds = {n: _speed(points, fps) * later for n, points in objects.items()}
    speeds = {n: s for n, s in speeds.items() if s.max() > MOVING_M_S}
    farthest = sorted(speeds, key=lambda n: (-float(speeds[n].sum()), n))
    return Traces(
        {f"a{i}": actions[:, i] for i in range(width) if i not in grippers},
        {f"a{i}": actions[:, i] for i in grippers},
        np.max([_speed(points, fps) for points in eef.values()], axis=0),
        {name: speeds[name] for name in farthest},
        _places(steps, list(eef.values()), objects, farthest, settle_steps),
    )


def action_labels(platform: str, width: int) -> dict[str, str]:
    """Returns the meaning of each number of an action, by its name in `Traces`."""
    names = platform_named(platform).action_names if platform in platform_names() else {}
    known = names.get(width) or tuple(f"action {i + 1}" for i in range(width))
    return {f"a{i}": label for i, label in enumerate(known)}


def positions(steps: Steps) -> dict[str, np.ndarray]:
    """(T + 1, 3) metres of every object; where it has a handle (`Simulator.bodies`), that of its handle."""
    objects = {n: p for n, p in steps.bodies.items() if not is_mark(n) and not n.startswith("eef")}
    return {n: steps.bodies.get(n + HANDLE, p)[:, :3] for n, p in objects.items()}


def _places(
    steps: Steps, hands: list[np.ndarray], objects: dict[str, np.ndarray], moved: list[str], start: int
) -> dict[str, Place]:
    found = {}
    for name, points in objects.items():
        mark = steps.bodies.get(name + GOAL_OF)
        if mark is None and name + HANDLE in steps.bodies:
            mark = steps.bodies.get(GOAL)
        goal = None if mark is None else np.linalg.norm(points - mark[:, :3], axis=1)[:-1]
        reach = np.min([np.linalg.norm(points - hand, axis=1) for hand in hands], axis=0)[:-1]
        away = points - points[min(start, len(points) - 1)]
        found[name] = Place(reach, goal, np.linalg.norm(away, axis=1)[:-1], away[:-1, 2])
    rank = {name: i for i, name in enumerate(moved)}

    def order(name: str) -> tuple:
        place = found[name]
        return place.goal_m is None, rank.get(name, len(rank)), float(place.reach_m.min()), name

    return {name: found[name] for name in sorted(found, key=order)[:MAX_PLACES]}


def suggest(
    steps: Steps, fps: float, first_step: int, labels: Mapping[str, str] | None = None
) -> list[Suggestion]:
    """Steps at which something went over into rest: where an annotator may want to look.

    An object that moved and lies still again; and where the end effector stays stuck up to the end.

    Args:
        steps: T + 1 states.
        fps: frames a second.
        first_step: the first step at which a recovery point may be.
        labels: what bodies are called, by name; as they are where it says nothing.
    """
    labels = labels or {}
    last = len(steps.perturbation) - 1
    found = []
    for name, points in positions(steps).items():
        moving = np.flatnonzero(_speed(points, fps) > MOVING_M_S)
        ends = [i for i, gap in zip(moving, np.diff(moving, append=10**9), strict=True) if gap > REST_S * fps]
        found += [Suggestion(int(i) + 1, f"{labels.get(name, name)} has come to rest", "rule") for i in ends]
    for name, poses in steps.bodies.items():
        if not name.startswith("eef"):
            continue
        away = np.linalg.norm(poses[:, :3] - poses[-1, :3], axis=1) > STUCK_M
        stuck = int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0
        if last - stuck >= STUCK_S * fps:
            called = labels.get(name, name)
            found.append(Suggestion(stuck, f"{called} stays where it is up to the end", "rule"))
    return sorted((s for s in found if first_step <= s.step <= last), key=lambda s: (s.step, s.reason))


def _speed(points: np.ndarray, fps: float) -> np.ndarray:
    """(T,) metres a second over the action that follows each frame, of (T + 1, 3) points."""
    return np.linalg.norm(np.diff(points, axis=0), axis=1) * fps
