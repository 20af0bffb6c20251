"""What becomes of each finished rollout: a candidate, an excluded candidate, or dropped, with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_roborecover.curation.collect.exclusions import Exclusion, judge, objects_of
from lerobot_roborecover.curation.collect.record import Record, read_record, record_path
from lerobot_roborecover.curation.collect.rollouts import RolloutJournal, RolloutOutcome
from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.curation.funnel import Decision
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.replay.recorder import PERTURBED, UNREACHABLE
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.utils.options import option

TOUCHED_TILT_DEG = 15.0
"""Tilt of an object, beyond any that it had in the undisturbed rollout, that counts as touched."""


@dataclass(frozen=True)
class FilterConfig:
    """Options that decide what is kept, not what is rolled out."""

    skip: tuple[str, ...] = option((), name="no-exclude", metavar="RULE")
    """Do not ask this exclusion rule."""
    only: tuple[str, ...] = option((), name="exclude-only", metavar="RULE")
    """Ask this exclusion rule alone."""
    min_displacement_mm: float = option(
        0.0, name="min-displacement", metavar="MM", text="", old=("scene-touched",)
    )
    """With --perturb: keep only rollouts in which an object ends at least so far from its path without
    disturbance, or tipped; runs each undisturbed, too.

    0 keeps all.
    """


@dataclass(frozen=True)
class RolloutVerdict:
    planned: RolloutSpec
    dropped: Decision | None
    """Why it is no candidate; None where it is one."""
    exclusion: Exclusion | None = None
    """Why a rule would leave the candidate out."""
    notes: dict[str, Any] | None = None
    """Measured values, for its provenance."""


@dataclass(frozen=True)
class SceneDisturbance:
    """The object that ends farthest from its undisturbed path."""

    body: str
    displaced_mm: float
    tilted_deg: float


def scene_disturbance(record: Record, twin: Record) -> SceneDisturbance:
    """How far the scene ends from every state that the undisturbed rollout had it in.

    For each object: the distance of its last position from the nearest on its path in the twin (its start
    among them), and the smallest angle between its last up axis and one that it had there. An object that the
    robot missed, or moved as it would have anyway, gives nothing; one that was knocked over, pushed aside or
    let go elsewhere does.

    Args:
        record: the perturbed rollout.
        twin: same controller, same start, same noise, undisturbed.
    """
    best, best_score = SceneDisturbance("", 0.0, 0.0), -1.0
    others = objects_of(twin)
    for name, poses in objects_of(record).items():
        path = others[name][twin.reset.settle_steps :]
        distance = 1e3 * float(np.linalg.norm(path[:, :3] - poses[-1, :3], axis=1).min())
        cosine = float((_up(path[:, 3:]) @ _up(poses[-1:, 3:])[0]).max())
        tilt = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        if distance + tilt > best_score:
            best, best_score = SceneDisturbance(name, distance, tilt), distance + tilt
    return best


def _up(quat_xyzw: np.ndarray) -> np.ndarray:
    """(n, 3) third columns of the rotations."""
    x, y, z, w = quat_xyzw.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def verdict(
    planned: RolloutSpec, ended: RolloutOutcome, book: RolloutJournal, judging: FilterConfig
) -> RolloutVerdict:
    """Judges one finished rollout; the same whenever it is asked.

    Args:
        planned: the rollout.
        ended: how it ended.
        book: where the records are.
        judging: the options.

    Raises:
        ScenarioError: its record is damaged.
    """

    def drop(reason: str, detail: str, by: str) -> RolloutVerdict:
        return RolloutVerdict(planned, Decision(planned.id, "collect", "dropped", reason, detail, by))

    if ended.outcome == Outcome.SUCCESS:
        return drop("succeeded", f"after {ended.steps} steps", "task predicate")
    if not ended.recorded:
        return drop(f"not run to its end: {ended.outcome}", ended.reason[:500], "collect")
    record = read_record(record_path(book.records, ended.rollout))
    flags = record.steps.perturbation
    notes: dict[str, Any] = {"trial": planned.trial}
    if planned.perturbed:
        notes["perturbed_steps"] = int((flags == PERTURBED).sum())
        notes["unreachable_steps"] = int((flags == UNREACHABLE).sum())
    if judging.min_displacement_mm:
        twin = book.find(replace(planned, twin=True).record_name)
        if twin is None or not twin.recorded:
            why = "it was not run" if twin is None else f"{twin.outcome}: {twin.reason}"[:500]
            return drop("no undisturbed twin to compare with", why, "scene-touched")
        touch = scene_disturbance(record, read_record(record_path(book.records, twin.rollout)))
        measured = (
            f"{touch.body} ends {touch.displaced_mm:.1f} mm and {touch.tilted_deg:.1f} degrees from its path "
            f"without disturbance (limits {judging.min_displacement_mm:g} mm or {TOUCHED_TILT_DEG:g} degrees)"
        )
        if touch.displaced_mm < judging.min_displacement_mm and touch.tilted_deg < TOUCHED_TILT_DEG:
            return drop("the disturbance did not touch the scene", measured, "scene-touched")
        notes["scene_touched"] = {
            "body": touch.body, "displaced_mm": round(touch.displaced_mm, 2),
            "tilted_deg": round(touch.tilted_deg, 2), "undisturbed": twin.outcome,
        }  # fmt: skip
    skip = judging.skip
    if np.isinf(platform_named(planned.task.platform).action_bound):
        skip = (*skip, "pressing")  # targets, which ask for no direction
    return RolloutVerdict(planned, None, judge(record, skip=skip, only=judging.only), notes)
