"""Part a: what the measures on pictures say of placings whose true error is known, by camera set-up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.robot.reference import Reference
from lerobot_roborecover.robot.start_check import StartCheck, Tolerance
from lerobot_roborecover.robot.vision import compare
from lerobot_roborecover.utils.journal import append_records, plain_records
from recipes.robot_lab.bench import FIRST_SCENE, Bench, lab, replay

POINTS, PLACINGS = 5, 20
MAX_ERROR_MM = 30.0
SEED = 11
TAG_SIDE_MM = 60.0


@dataclass(frozen=True)
class Setup:
    """A camera set-up, and what differs from the recording when a start is measured."""

    options: dict[str, Any] = field(default_factory=dict)
    """Of the lab's configuration."""
    boxes: bool = True
    """People have drawn where the objects are."""
    bump_px: tuple[float, float] = (0.0, 0.0)
    """The camera was moved since."""
    cleared: bool = True
    """The cleared table was looked at."""
    arm_mm: float = 0.0
    """The arm stands off by this much, along both axes."""

    @property
    def folder(self) -> str:
        """Name of its recordings; set-ups that record alike share them."""
        return "_".join(f"{k}-{v}" for k, v in sorted(self.options.items())) or "standard"

    @property
    def mm_per_px(self) -> float:
        return 1000.0 / self.options.get("size", 96)


SETUPS = {
    "standard: 96 px, object drawn": Setup(),
    "48 px": Setup({"size": 48}),
    "192 px": Setup({"size": 192}),
    "noise of 8 grey levels": Setup({"image_noise": 8.0}),
    "no object drawn": Setup(boxes=False),
    "table not cleared": Setup(cleared=False),
    "camera moved by 5 px": Setup(bump_px=(4.0, -3.0)),
    "arm 4 mm off": Setup(arm_mm=4.0),
    "tags": Setup({"tags": True}),
}
METAWORLD = "Meta-World, 96 px, slanted camera, no object drawn"


def run(out: Path) -> Path:
    """Measures the set-ups that are not measured yet; returns the file of measurements."""
    path = out / "start_errors.jsonl"
    for name in (*SETUPS, METAWORLD):
        if not any(r["setup"] == name for r in plain_records(path)):
            measured = _metaworld(out) if name == METAWORLD else _table(out, name, SETUPS[name])
            append_records(path, *measured)
        print(f"{name}: measured", flush=True)
    return path


def _offsets() -> np.ndarray:
    """(POINTS, PLACINGS, 2) millimetres: any direction, and any size up to the largest."""
    rng = np.random.default_rng(SEED)
    size, turn = rng.uniform(0, [MAX_ERROR_MM, 2 * np.pi], (POINTS, PLACINGS, 2)).transpose(2, 0, 1)
    return size[..., None] * np.stack([np.cos(turn), np.sin(turn)], -1)


def _table(out: Path, name: str, setup: Setup) -> Iterator[dict[str, Any]]:
    bench = Bench(out / "setups" / setup.folder, setup.options, POINTS)
    points = bench.points
    tolerance = Tolerance(tag_side_mm=TAG_SIDE_MM if setup.options.get("tags") else 0.0)
    with bench.lab() as robot:
        for point, offsets in zip(points.points, _offsets(), strict=True):
            seen = point if setup.boxes else replace(point, boxes={})
            check = StartCheck(points, seen, tolerance)
            robot.world.bump("top", setup.bump_px)
            robot.new_scene(FIRST_SCENE)
            robot.world.clear()
            check.see_table(robot)
            replay(robot, point)
            _push_arm(robot, setup.arm_mm)
            if setup.cleared:
                robot.world.clear()
                check.see_cleared(robot)
            for offset in offsets:
                robot.world.place(dict(point.truth["objects"]), offset / 1000, 0.0)
                error, _ = check.measure(robot)
                top = error.cameras["top"]
                estimate = top.tag_mm if tolerance.tag_side_mm else _times(top.object_px, setup.mm_per_px)
                yield _record(name, point.id, robot, point.truth["objects"], estimate, top.background_px)
            robot.world.bump("top", (0.0, 0.0))


def _push_arm(robot: Any, arm_mm: float) -> None:
    """Lets the arm stand off; without, it comes to rest where it is."""
    here = robot.world.positions()
    for _ in range(20):
        robot.world.step(here + arm_mm)


def _metaworld(out: Path) -> Iterator[dict[str, Any]]:
    """Scenes of a Meta-World task. No policy of ours drives that robot by positions: the episode is the arm
    on its way, and an object that is moved once."""
    with lab(out, world="metaworld", task="push-v3", size=96) as robot:
        for scene, offsets in enumerate(_offsets()):
            robot.new_scene(scene)
            start, away = robot.world.positions(), np.array([0.0, -60.0, 80.0, 0.0])
            before = robot.hidden_truth()["objects"]
            robot.world.place(before, np.array([0.04, 0.03]), 0.0)
            truth = robot.hidden_truth()["objects"]
            frames = []
            for moment, part in enumerate(np.linspace(0, 1, 8)):
                robot.world.place(before if moment < 5 else truth, np.zeros(2), 0.0)
                for _ in range(8):
                    robot.world.step(start + part * away)
                frames.append(_look(robot))
            robot.world.clear()
            cleared = _look(robot)
            for _ in range(40):
                robot.world.step(start)
            reference = Reference.of(np.stack(frames)).with_cleared(_look(robot), cleared)
            for _ in range(40):
                robot.world.step(start + away)
            for offset in offsets:
                robot.world.place(truth, offset / 1000, 0.0)
                found = compare(reference, _look(robot))
                yield {
                    **_record(METAWORLD, f"scene-{scene}", robot, truth, None, found.background_px),
                    "object_px": found.object_px,
                }


def _look(robot: Any) -> np.ndarray:
    """The present picture, once those that are late have come."""
    return [robot.get_observation()["front"] for _ in range(3)][-1]


def _record(
    setup: str, point: str, robot: Any, truth: Any, estimate: float | None, background_px: float | None
) -> dict[str, Any]:
    true_mm = 1000 * robot.world.distance_m(dict(truth))
    return {
        "setup": setup,
        "point": point,
        "true_mm": round(true_mm, 3),
        "estimate_mm": None if estimate is None else round(estimate, 3),
        "background_px": None if background_px is None else round(background_px, 3),
    }


def _times(pixels: float | None, mm_per_px: float) -> float | None:
    return None if pixels is None else pixels * mm_per_px


@dataclass(frozen=True)
class Accuracy:
    """How well one set-up measures."""

    placings: int
    missing: int
    """Placings of which there is no number."""
    bias_mm: float
    """Mean of estimated minus true."""
    spread_mm: float
    """Standard deviation of the same."""
    within_mm: float
    """Nine in ten are within this of the truth."""
    missed: float
    """Share of placings at least 15 mm off that are measured as at most 10 mm."""
    refused: float
    """Share of placings at most 5 mm off that are measured as more than 10 mm."""
    camera_px: float
    """Median shift of the camera as measured."""


def accuracy(records: list[dict[str, Any]]) -> Accuracy:
    """How well a set-up measures.

    Args:
        records: of the set-up; pixels without a scale get that of least squares through zero.
    """
    known = [r for r in records if _value(r) is not None]
    camera_px = float(
        np.median([np.nan if r["background_px"] is None else r["background_px"] for r in records])
    )
    if not known:
        return Accuracy(len(records), len(records), *[float("nan")] * 5, camera_px)
    true = np.array([r["true_mm"] for r in known])
    found = np.array([_value(r) for r in known], float)
    if known and "object_px" in known[0]:
        found = found * float(true @ found) / float(found @ found)
    gap = found - true
    return Accuracy(
        len(records),
        len(records) - len(known),
        float(gap.mean()),
        float(gap.std(ddof=1)),
        float(np.quantile(np.abs(gap), 0.9)),
        float((found[true >= 15.0] <= 10.0).mean()),
        float((found[true <= 5.0] > 10.0).mean()),
        camera_px,
    )


def _value(record: dict[str, Any]) -> float | None:
    return record.get("object_px", record["estimate_mm"])
