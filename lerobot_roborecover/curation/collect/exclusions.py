"""Rules that would leave a rollout out, each with its measure and its limit.

They only suggest: an excluded rollout is in the dataset, with the values behind the exclusion in its
decision, and a person's decision takes it back (docs/build.md). The paper excludes erratic or out-of-region
motion, irreversible damage, and states in which the robot cannot go on; it states no limits, so those here
are ours. All measures are of the interaction alone: settling is left out, and where the motion itself is
judged, so are the steps in which actions were perturbed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.curation.collect.record import Record
from lerobot_roborecover.platforms.simulator import is_mark
from lerobot_roborecover.replay.recorder import PERTURBED
from lerobot_roborecover.scenario import ScenarioError

ERRATIC_SHARE = 0.35
"""Share of the moving steps in which the end effector turns back on its last motion."""
ERRATIC_SPEED_M = 0.001
"""Metres in a step from which on it counts as moving."""
ERRATIC_STEPS = 30
"""Moving steps below which nothing is said."""
OUTSIDE_STEPS = 20
"""Steps outside the workspace, in a row."""
OUTSIDE_M = 0.02
"""How far outside."""
FALLEN_M = 0.05
"""How far below the support an object's middle is when it has fallen off."""
LIMIT_RAD = 0.01
"""Distance from a joint's limit that counts as at it."""
LIMIT_STEPS = 60
"""Last steps of a rollout, at least, in which a joint is at its limit and the end effector stays."""
PRESSING_SHARE = 0.8
"""Last part of a rollout, at least, in which the end effector is commanded to move and stays. That a policy
ends stuck is an ordinary failure, with a recovery point before it; here there is almost nothing."""
PRESSING_COMMAND = 0.5
"""Translation of a command, (-1 to 1), that asks for motion."""
STAYS_M = 0.02
"""How far the end effector is from where it ends, at most, when it stays."""
REST_M = 0.001
"""How far an object at rest moves in the last `REST_STEPS`."""
REST_STEPS = 20
MOVED_M = 0.02
"""How far an object is from its start when it has been moved."""
OUT_OF_REACH_M = 0.05
"""How far beyond the workspace, horizontally, an object lies out of reach."""


@dataclass(frozen=True)
class Exclusion:
    """A rule's verdict."""

    rule: str
    reason: str
    """A few words that many candidates share."""
    detail: str
    """Measured values and limits."""


def judge(record: Record, *, skip: Collection[str] = (), only: Collection[str] = ()) -> Exclusion | None:
    """The first rule that would leave a rollout out, or None.

    Args:
        record: the rollout.
        skip: rules that are not asked.
        only: rules that are asked alone; empty for all.
    """
    for name, (rule, reason) in RULES.items():
        if name in skip or (only and name not in only):
            continue
        detail = rule(record)
        if detail:
            return Exclusion(name, reason, detail)
    return None


def check_rules(option: str, names: Collection[str]) -> None:
    """Refuses names of rules that there are not.

    Raises:
        ScenarioError: naming those that there are.
    """
    unknown = [n for n in names if n not in RULES]
    if unknown:
        raise ScenarioError(f"{option} {unknown[0]!r:.80}: no such rule; there are {', '.join(RULES)}")


def objects_of(record: Record) -> dict[str, np.ndarray]:
    """(T + 1, 7) poses of what can move, the robot and marks left out."""
    return {
        name: poses
        for name, poses in record.steps.bodies.items()
        if not name.startswith("eef") and not is_mark(name)
    }


def _hands(record: Record) -> dict[str, np.ndarray]:
    """(T' + 1, 3) positions of the end effectors from the end of settling on."""
    settle = record.reset.settle_steps
    return {n: p[settle:, :3] for n, p in record.steps.bodies.items() if n.startswith("eef")}


def _stays(record: Record) -> np.ndarray:
    """(T' + 1,) bool: whether every end effector is where it ends."""
    off = [np.linalg.norm(path - path[-1], axis=1) for path in _hands(record).values()]
    return np.max(off, axis=0) <= STAYS_M


def _erratic(record: Record) -> str:
    quiet = record.steps.perturbation[record.reset.settle_steps :] != PERTURBED
    for name, path in _hands(record).items():
        motion = np.diff(path, axis=0)
        speed = np.linalg.norm(motion, axis=1)
        pair = (speed[1:] > ERRATIC_SPEED_M) & (speed[:-1] > ERRATIC_SPEED_M) & quiet[1:] & quiet[:-1]
        if pair.sum() < ERRATIC_STEPS:
            continue
        share = float(((motion[1:] * motion[:-1]).sum(1) < 0)[pair].mean())
        if share > ERRATIC_SHARE:
            return (
                f"{name} turns back in {share:.0%} of its {int(pair.sum())} moving steps "
                f"(limit {ERRATIC_SHARE:.0%})"
            )
    return ""


def _outside(record: Record) -> str:
    place = record.workspace
    if place is None:
        return ""
    for name, path in _hands(record).items():
        beyond = np.maximum(np.subtract(place.low_m, path), path - place.high_m).max(1)
        steps = _longest(beyond > OUTSIDE_M)
        if steps >= OUTSIDE_STEPS:
            return (
                f"{name} is up to {1e3 * float(beyond.max()):.0f} mm outside the workspace, {steps} steps in "
                f"a row (limits {1e3 * OUTSIDE_M:.0f} mm, {OUTSIDE_STEPS} steps)"
            )
    return ""


def _fallen(record: Record) -> str:
    place = record.workspace
    if place is None:
        return ""
    floor = place.support_m - FALLEN_M
    for name, poses in objects_of(record).items():
        height = poses[record.reset.settle_steps :, 2]
        if height[0] >= floor and height.min() < floor:
            step = record.reset.settle_steps + int(np.argmax(height < floor))
            return (
                f"{name} falls to {1e3 * (float(height.min()) - place.support_m):.0f} mm relative to its "
                f"support (limit -{1e3 * FALLEN_M:.0f} mm), from step {step} on"
            )
    return ""


def _at_limit(record: Record) -> str:
    margin = record.margin_rad[record.reset.settle_steps :]
    steps = _trailing((margin < LIMIT_RAD) & _stays(record))
    if steps >= LIMIT_STEPS:
        return (
            f"a joint is within {LIMIT_RAD:g} rad of its limit (smallest distance "
            f"{float(margin[-steps:].min()):.3f} rad), and the end effector stays, in the last {steps} steps "
            f"(limit {LIMIT_STEPS})"
        )
    return ""


def _pressing(record: Record) -> str:
    settle = record.reset.settle_steps
    if len(_hands(record)) != 1:  # two arms' joint targets do not ask for a direction
        return ""
    asked = np.linalg.norm(np.clip(record.actions[settle:, :3], -1, 1), axis=1) >= PRESSING_COMMAND
    steps = _trailing(asked & _stays(record)[1:])
    if steps >= PRESSING_SHARE * len(asked):
        return (
            f"the end effector is commanded to move (at least {PRESSING_COMMAND:g}) and stays within "
            f"{1e3 * STAYS_M:.0f} mm in the last {steps} of {len(asked)} steps (limit {PRESSING_SHARE:.0%})"
        )
    return ""


def _irreversible(record: Record) -> str:
    place, settle = record.workspace, record.reset.settle_steps
    if place is None:
        return ""
    low, high = np.array(place.low_m[:2]) - OUT_OF_REACH_M, np.array(place.high_m[:2]) + OUT_OF_REACH_M
    for name, poses in objects_of(record).items():
        path = poses[settle:, :3]
        at_rest = np.linalg.norm(path[-REST_STEPS:] - path[-1], axis=1).max() < REST_M
        moved = float(np.linalg.norm(path[-1] - path[0]))
        beyond = float(np.maximum(low - path[-1, :2], path[-1, :2] - high).max())
        if at_rest and moved > MOVED_M and beyond > 0:
            return (
                f"{name} was moved by {1e3 * moved:.0f} mm and lies at rest "
                f"{1e3 * (beyond + OUT_OF_REACH_M):.0f} mm outside the workspace (limit "
                f"{1e3 * OUT_OF_REACH_M:.0f} mm)"
            )
    return ""


def _longest(flags: np.ndarray) -> int:
    """Length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0


def _trailing(flags: np.ndarray) -> int:
    """Length of the run of True at the end."""
    return int(len(flags) if flags.all() else np.argmin(flags[::-1]))


RULES: Mapping[str, tuple[Callable[[Record], str], str]] = {
    "fallen": (_fallen, "object off the table"),
    "irreversible": (_irreversible, "irreversible: object out of reach"),
    "outside": (_outside, "out-of-region motion"),
    "erratic": (_erratic, "erratic motion"),
    "joint-limit": (_at_limit, "stuck at a joint limit"),
    "pressing": (_pressing, "pressing without moving"),
}
"""Measure and reason by name, in the order in which they are asked."""
