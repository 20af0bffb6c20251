"""Compares a live picture with a recorded one: has the camera moved, have the objects, by how much?

The order matters. The arm is put back first, so that it covers the same pixels in both pictures. The camera
is judged on the static background: pixels that did not change while the episode was recorded. Only after its
shift is taken out are objects compared: what the recorded picture has more than one of the cleared table, the
arm where it was. The arm is in both and drops out, and where it covers an object nothing is compared. Without
a picture of the cleared table, the regions that people have drawn are compared, or the foreground of the
recovery point, arm and all. LeRobot #4496 shows what happens otherwise: a tripod that moved is scored as the
policy's failure.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from lerobot_roborecover.logs.robot import CameraError
from lerobot_roborecover.robot.reference import CHANGED, Reference, aligned, background_shift, differ

_MIN_REGION_PX = 12
_SEARCH = 0.2
"""How far an object is looked for, as a share of the picture's side."""
_MIN_SEEN = 0.1
"""Least share of a drawn region that the arm has to leave open."""
_ARM_OFF = 0.015
"""Share of a picture's side by which an arm that came back may be off: servos give way under load."""
_ALIKE = 0.15
"""Scores of an object behind the arm that differ by less do not tell its places apart."""
_TAGS = cv2.aruco.DICT_4X4_50


def compare(reference: Reference, live: np.ndarray, tag_side_mm: float | None = None) -> CameraError:
    """Measures how a live picture differs from the recorded one.

    Args:
        reference: the recorded picture.
        live: (H, W, 3) uint8, with the arm where it was.
        tag_side_mm: side of the fiducial tags (ArUco 4x4_50) in the scene; None looks for none.
    """
    shift = background_shift(reference, live)
    shift_px = None if shift is None else float(np.hypot(*shift))
    object_px, similarity = object_shift(reference, aligned(live, shift))
    tag_mm = None if tag_side_mm is None else tag_shift_mm(reference.picture, live, tag_side_mm)
    return CameraError(shift_px, object_px, similarity, tag_mm)


def object_shift(reference: Reference, live: np.ndarray) -> tuple[float | None, float | None]:
    """Pixels by which the object region has shifted, and its similarity there.

    Args:
        reference: the recorded picture.
        live: (H, W, 3) uint8, with the camera's own shift taken out.

    Returns:
        None each where the region is too small, has no structure, or the arm stands before it.
    """
    reach = max(round(_SEARCH * max(reference.picture.shape[:2])), 3)
    if _hidden(reference):
        return None, None
    added = _added(reference)
    if added is not None:
        found = [_behind_the_arm(reference, live, _padded(box, added.shape), reach) for box in _boxes(added)]
    else:
        found = [_as_drawn(reference, live, box, reach) for box in _boxes(reference.objects)]
    kept = [pair for pair in found if pair is not None]
    if not kept:
        return None, None
    return max(shift for shift, _ in kept), min(similarity for _, similarity in kept)


def _as_drawn(
    reference: Reference, live: np.ndarray, box: tuple[int, int, int, int], reach: int
) -> tuple[float, float] | None:
    """Shift and similarity of a region, with everything that is seen in it."""
    left, top, width, height = box
    patch = reference.picture[top : top + height, left : left + width]
    mask = reference.objects[top : top + height, left : left + width]
    y0, x0 = max(top - reach, 0), max(left - reach, 0)
    around = live[y0 : top + height + reach, x0 : left + width + reach]
    if around.shape[0] <= height or around.shape[1] <= width or patch.std() < 2.0:
        return None
    weights = np.repeat(mask.astype(np.float32)[..., None], 3, 2)
    scores = cv2.matchTemplate(
        around.astype(np.float32), patch.astype(np.float32), cv2.TM_CCOEFF_NORMED, mask=weights
    )
    scores = np.where(np.isfinite(scores), scores, -1.0)
    row, column = np.unravel_index(int(scores.argmax()), scores.shape)
    fine_row, fine_column = _peak(scores, int(row), int(column))
    shift = float(np.hypot(x0 + fine_column - left, y0 + fine_row - top))
    return shift, float(np.clip(scores[row, column], -1.0, 1.0))


def _behind_the_arm(
    reference: Reference, live: np.ndarray, box: tuple[int, int, int, int], reach: int
) -> tuple[float, float] | None:
    """Shift and similarity of an object: what either picture has more than the cleared table, compared where
    the arm covers the object in neither."""
    assert reference.cleared is not None
    assert reference.arm is not None
    left, top, width, height = box
    free = ~reference.arm
    recorded = (reference.picture.astype(np.float32) - reference.cleared) * free[..., None]
    seen = (live.astype(np.float32) - reference.cleared) * free[..., None]
    edge = ((reach, reach), (reach, reach))
    around = np.pad(seen, (*edge, (0, 0)))[top : top + height + 2 * reach, left : left + width + 2 * reach]
    open_there = np.pad(free, edge)[top : top + height + 2 * reach, left : left + width + 2 * reach]
    patch = recorded[top : top + height, left : left + width]
    open_here = free[top : top + height, left : left + width].astype(np.float32)
    there = open_there.astype(np.float32)

    def sums(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        """(2 reach + 1, 2 reach + 1) sums of products at every shift."""
        return cv2.matchTemplate(image.astype(np.float32), kernel.astype(np.float32), cv2.TM_CCORR)

    own, other = sums(there, (patch**2).sum(-1)), sums((around**2).sum(-1), open_here)
    both = np.sum([sums(around[..., k], patch[..., k]) for k in range(3)], 0)
    least = 0.1 * own.max()
    scores = np.where((own > least) & (other > 0), 2 * both / np.maximum(own + other, 1e-6), -1.0)
    if scores.max() <= 0:
        return None
    # What the arm leaves of an object may fit in several places: it is at the nearest of those that fit.
    tops = (scores >= cv2.dilate(scores, np.ones((3, 3)))) & (scores >= scores.max() - _ALIKE)
    rows, columns = np.nonzero(tops)
    nearest = int(np.hypot(rows - reach, columns - reach).argmin())
    row, column = rows[nearest], columns[nearest]
    fine_row, fine_column = _peak(scores, int(row), int(column))
    shift = float(np.hypot(fine_column - reach, fine_row - reach))
    return shift, float(np.clip(scores[row, column], -1.0, 1.0))


def _added(reference: Reference) -> np.ndarray | None:
    """(H, W) bool: what the recorded picture has more than the cleared table; None where that is nothing."""
    if reference.cleared is None:
        return None
    gap = differ(reference.picture, reference.cleared, 0.8, CHANGED).astype(np.uint8)
    # An arm that stands a fraction of a pixel off leaves thin lines along its edges.
    found = cv2.morphologyEx(gap, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    added = cv2.dilate(found, np.ones((3, 3), np.uint8)).astype(bool)
    if reference.drawn:
        added &= reference.objects
    return added if added.sum() >= _MIN_REGION_PX else None


def _hidden(reference: Reference) -> bool:
    """Whether the arm stands before nearly all of what people have drawn: that camera says nothing of it."""
    if reference.arm is None or not reference.drawn:
        return False
    wide = 2 * round(_ARM_OFF * max(reference.arm.shape)) + 1
    arm = cv2.dilate(reference.arm.astype(np.uint8), np.ones((wide, wide), np.uint8)).astype(bool)
    seen = reference.objects & ~arm
    return bool(seen.sum() < max(_MIN_REGION_PX, _MIN_SEEN * reference.objects.sum()))


def _padded(box: tuple[int, int, int, int], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """A box with a margin, within a picture."""
    left, top = max(box[0] - 2, 0), max(box[1] - 2, 0)
    right, bottom = min(box[0] + box[2] + 2, shape[1]), min(box[1] + box[3] + 2, shape[0])
    return left, top, right - left, bottom - top


def _peak(scores: np.ndarray, row: int, column: int) -> tuple[float, float]:
    """A maximum between pixels: the top of a parabola through its neighbours, along each axis."""

    def along(before: float, here: float, after: float) -> float:
        curve = before - 2 * here + after
        return 0.0 if curve >= -1e-9 else float(np.clip(0.5 * (before - after) / curve, -0.5, 0.5))

    fine_row, fine_column = float(row), float(column)
    if 0 < row < scores.shape[0] - 1:
        fine_row += along(*scores[row - 1 : row + 2, column])
    if 0 < column < scores.shape[1] - 1:
        fine_column += along(*scores[row, column - 1 : column + 2])
    return fine_row, fine_column


def tag_shift_mm(recorded: np.ndarray, live: np.ndarray, side_mm: float) -> float | None:
    """Largest shift of a tag that both pictures show, millimetres in the tag's own plane.

    The tag's side in pixels gives the scale, so no calibration of the camera is needed.

    Args:
        recorded: (H, W, 3) uint8.
        live: (H, W, 3) uint8.
        side_mm: of the tags.
    """
    before, now = find_tags(recorded), find_tags(live)
    found = []
    for number in before.keys() & now.keys():
        corners = before[number]
        side_px = np.linalg.norm(np.roll(corners, 1, 0) - corners, axis=1).mean()
        gap_px = np.linalg.norm(now[number].mean(0) - corners.mean(0))
        found.append(float(side_mm * gap_px / side_px))
    return max(found, default=None)


def find_tags(picture: np.ndarray) -> Mapping[int, np.ndarray]:
    """(4, 2) corners in pixels of each tag (ArUco 4x4_50) by number."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = 0.02
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_TAGS), parameters)
    # Small pictures are enlarged: the detector's bit cells need some pixels each.
    scale = max(1, round(480 / max(picture.shape[:2])))
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    corners, numbers, _ = detector.detectMarkers(large)
    if numbers is None:
        return {}
    return {int(n): c.reshape(4, 2) / scale for n, c in zip(numbers.ravel(), corners, strict=True)}


def ghost(recorded: np.ndarray, live: np.ndarray, view: str) -> np.ndarray:
    """What a person sees who puts a scene back: (H, W, 3) uint8.

    Args:
        recorded: (H, W, 3) uint8.
        live: (H, W, 3) uint8 of the same size.
        view: `blend`, `difference`, `edges` (recorded red, live green), `recorded` or `live`.
    """
    if view == "difference":
        return cv2.absdiff(recorded, live)
    if view == "edges":
        edges = [cv2.Canny(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY), 60, 140) for p in (recorded, live)]
        return np.stack([*edges, np.zeros_like(edges[0])], -1)
    if view in ("recorded", "live"):
        return recorded if view == "recorded" else live
    return cv2.addWeighted(recorded, 0.5, live, 0.5, 0.0)


def _boxes(mask: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Left, top, width and height of the connected regions of a mask, the largest three."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    found = sorted(stats[1:count].tolist(), key=lambda s: -s[cv2.CC_STAT_AREA])
    return [tuple(s[:4]) for s in found if s[cv2.CC_STAT_AREA] >= _MIN_REGION_PX][:3]
