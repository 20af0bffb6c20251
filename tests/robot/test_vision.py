"""What two pictures say of a camera and of objects, against shifts that are known."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_roborecover.robot.lab.table_camera import TableCamera
from lerobot_roborecover.robot.reference import Reference, background_shift
from lerobot_roborecover.robot.vision import (
    compare,
    find_tags,
    ghost,
    tag_shift_mm,
)

PUCK, HAND = np.array([0.05, 0.1]), np.array([-0.1, -0.2])
MM_PER_PX = 1000 / 96
RNG = np.random.default_rng(0)


def seen(camera: TableCamera, puck=PUCK, hand=HAND, noise=2.0):
    picture = camera.picture(np.asarray(hand), np.asarray(puck)).astype(float)
    return np.clip(picture + RNG.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def episode(camera: TableCamera):
    """Eight moments: the hand comes near and pushes the puck, which was elsewhere before."""
    hands = np.linspace((0.0, -0.35), HAND, 8)
    pucks = np.linspace((-0.1, 0.2), PUCK, 8)
    pucks[:6] = (-0.1, 0.2)
    pucks[-1] = PUCK
    return np.stack([seen(camera, p, h) for p, h in zip(pucks, hands, strict=True)])


def boxed(reference: Reference) -> Reference:
    column, row = (0.5 + PUCK[0]) * 96, (0.5 - PUCK[1]) * 96
    return reference.with_boxes([(round(column) - 6, round(row) - 6, 13, 13)])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.3), (3.3, 1.8), (-9.0, 5.5), (14.0, -11.0)])
def test_a_bumped_camera_is_measured_to_a_fraction_of_a_pixel(shift):
    camera = TableCamera(96, 1.0)
    reference = Reference.of(episode(camera))
    camera.shift_px = np.array(shift)
    found = background_shift(reference, seen(camera))
    np.testing.assert_allclose(found, shift, atol=0.3)


@pytest.mark.parametrize("offset_mm", [(0.0, 0.0), (6.0, -4.0), (25.0, 10.0), (-60.0, 40.0)])
def test_a_displaced_object_is_measured_and_the_camera_is_not_blamed(offset_mm):
    camera = TableCamera(96, 1.0)
    reference = boxed(Reference.of(episode(camera)))
    found = compare(reference, seen(camera, PUCK + np.array(offset_mm) / 1000))
    assert found.background_px < 0.4
    assert found.object_px * MM_PER_PX == pytest.approx(np.hypot(*offset_mm), abs=3.5)


@pytest.mark.parametrize("offset_mm", [(0.0, 0.0), (3.0, 0.0), (0.0, -12.0), (-8.0, 6.0)])
def test_an_object_half_behind_the_arm_is_measured_without_the_arm(offset_mm):
    camera, away = TableCamera(96, 1.0), (0.95, 0.95)
    puck = HAND + np.array([0.01, -0.1])
    hands = np.linspace((0.0, -0.35), HAND, 8)
    frames = np.stack([seen(camera, (-0.1, 0.2) if i < 6 else puck, hand) for i, hand in enumerate(hands)])
    (box,) = camera.box(HAND, puck)
    reference = Reference.of(frames).with_boxes([tuple(box)])
    cleared = reference.with_cleared(seen(camera, away, (0.0, -0.35)), seen(camera, away))
    live = seen(camera, puck + np.array(offset_mm) / 1000)
    left, top = (round(v) for v in (0.5 + HAND * (1, -1)) * 96)
    assert compare(cleared.with_boxes([(left - 1, top - 1, 3, 3)]), live).object_px is None, (
        "all behind the arm"
    )
    assert compare(cleared, live).object_px * MM_PER_PX == pytest.approx(np.hypot(*offset_mm), abs=4.0)


def test_both_at_once_are_told_apart():
    camera = TableCamera(96, 1.0)
    reference = boxed(Reference.of(episode(camera)))
    camera.shift_px = np.array((5.0, -4.0))
    found = compare(reference, seen(camera, np.add(PUCK, (0.03, 0.0))))
    assert found.background_px == pytest.approx(np.hypot(5, 4), abs=0.5)
    assert found.object_px * MM_PER_PX == pytest.approx(30.0, abs=4.0)


def test_without_drawn_boxes_the_moved_object_is_found():
    camera = TableCamera(96, 1.0)
    reference = Reference.of(episode(camera))
    column, row = round((0.5 + PUCK[0]) * 96), round((0.5 - PUCK[1]) * 96)
    assert reference.objects[row, column]
    assert not reference.static[row, column]
    assert compare(reference, seen(camera)).object_px < 0.8
    assert compare(reference, seen(camera, np.add(PUCK, (0.0, 0.05)))).object_px > 2.0


def test_a_missing_object_is_unlike():
    camera = TableCamera(96, 1.0)
    reference = boxed(Reference.of(episode(camera)))
    there, gone = compare(reference, seen(camera)), compare(reference, seen(camera, (0.9, 0.9)))
    assert there.similarity > 0.95
    assert gone.similarity < 0.8


def test_tags_give_millimetres():
    camera = TableCamera(192, 1.0, tags=True)
    recorded = seen(camera)
    assert set(find_tags(recorded)) == {0, 1}
    assert tag_shift_mm(recorded, seen(camera), 60.0) < 1.5
    moved = seen(camera, np.add(PUCK, (0.02, 0.01)))
    assert tag_shift_mm(recorded, moved, 60.0) == pytest.approx(np.hypot(20, 10), abs=2.5)
    assert tag_shift_mm(recorded, np.zeros_like(recorded), 60.0) is None


def test_a_picture_without_structure_gives_no_number():
    blank = np.full((2, 64, 64, 3), 128, np.uint8)
    found = compare(Reference.of(blank), blank[0])
    assert (found.background_px, found.object_px, found.similarity) == (None, None, None)


def test_the_views_of_the_ghost():
    camera = TableCamera(64, 1.0)
    one, other = seen(camera, noise=0), seen(camera, np.add(PUCK, (0.05, 0.0)), noise=0)
    assert not ghost(one, one, "difference").any()
    assert ghost(one, other, "difference").any()
    for view in ("blend", "edges", "recorded", "live"):
        assert ghost(one, other, view).shape == one.shape
