"""Pictures of the lab's table from above: a structured table top, an arm, a puck, and tags if wanted."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

PX_PER_M = 500
"""Resolution of the drawn table."""
_SIDE_M = 2.0
PUCK_RADIUS_M = 0.045
PUCK_RGB, HAND_RGB, GOAL_RGB = (30, 160, 60), (215, 60, 50), (60, 90, 220)
"""The colours by which people, and the lab's scripted policy, tell things apart."""
GOALS_M = ((-0.3, 0.0), (0.3, 0.0))
TAG_SIDE_M = 0.06
_TABLE_TAG_M = (0.0, 0.36)


class TableCamera:
    """A camera that looks straight down.

    Args:
        size: rows and columns of a picture.
        field_m: side of the square that it sees.
        follows: it is on the hand, not on a stand.
        tags: tags lie on the puck and on the table.
    """

    def __init__(self, size: int, field_m: float, *, follows: bool = False, tags: bool = False):
        self._size, self._field_m, self._follows, self._tags = size, field_m, follows, tags
        self.shift_px: np.ndarray = np.zeros(2)
        """Columns and rows by which a bump has shifted the picture."""

    def picture(self, hand_m: np.ndarray, puck_m: np.ndarray) -> np.ndarray:
        """(size, size, 3) uint8.

        Args:
            hand_m: (2,) position of the hand.
            puck_m: (2,) position of the puck.
        """
        scale, offset = self._view(hand_m)
        blur = 0.4 / scale if scale < 1 else 0.0  # without it, thin structure flickers from pixel to pixel
        left, top, right, bottom = self._seen(scale, offset, margin=4 * blur + 3)
        scene = _table(self._tags)[top:bottom, left:right].copy()
        corner = np.array([left, top])
        _disc(scene, corner, puck_m, PUCK_RADIUS_M, PUCK_RGB)
        if self._tags:
            _tag(scene, corner, puck_m, 0)
        # The arm comes from the edge of the table at the robot's side.
        base, hand = (np.array(_pixel(end)) - corner for end in ((hand_m[0] * 0.3, -0.98), hand_m))
        cv2.line(scene, base.tolist(), hand.tolist(), (70, 70, 78), 22, cv2.LINE_AA)
        _disc(scene, corner, hand_m, 0.035, HAND_RGB)
        matrix = np.array([[scale, 0.0, offset[0] + scale * left], [0.0, scale, offset[1] + scale * top]])
        if blur:
            scene = cv2.GaussianBlur(scene, (0, 0), blur)
        return cv2.warpAffine(
            scene, matrix, (self._size, self._size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )

    def _seen(self, scale: float, offset: np.ndarray, margin: float) -> tuple[int, int, int, int]:
        """Left, top, right and bottom of the part of the drawn table that the picture shows, and a margin."""
        ends = (np.array([[0.0], [self._size - 1.0]]) - offset) / scale
        side = round(_SIDE_M * PX_PER_M)
        low = np.clip(np.floor(ends[0] - margin), 0, side - 1).astype(int)
        high = np.clip(np.ceil(ends[1] + margin), low + 1, side).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def box(self, hand_m: np.ndarray, puck_m: np.ndarray) -> list[list[int]]:
        """Left, top, width and height in pixels around the puck; none where it is not in the picture.

        Args:
            hand_m: (2,) position of the hand.
            puck_m: (2,) position of the puck.
        """
        scale, offset = self._view(hand_m)
        column, row = scale * np.array(_pixel(puck_m)) + offset
        half = PUCK_RADIUS_M * PX_PER_M * scale + 2
        left, top = round(column - half), round(row - half)
        side = round(2 * half)
        inside = min(left, top) >= 0 and max(left, top) + side <= self._size
        return [[left, top, side, side]] if inside else []

    def _view(self, hand_m: np.ndarray) -> tuple[float, np.ndarray]:
        """Scale and (2,) offset that bring the drawn table into the picture."""
        scale = self._size / (self._field_m * PX_PER_M)
        middle = np.array(_pixel(hand_m if self._follows else (0.0, 0.0)), float)
        return scale, (self._size - 1) / 2 - scale * middle + self.shift_px


def _pixel(point_m: tuple[float, float] | np.ndarray) -> tuple[int, int]:
    """Column and row of a place on the table."""
    x, y = float(point_m[0]), float(point_m[1])
    return round((x + _SIDE_M / 2) * PX_PER_M), round((_SIDE_M / 2 - y) * PX_PER_M)


def _disc(
    scene: np.ndarray, corner: np.ndarray, place_m: np.ndarray, radius_m: float, rgb: tuple[int, int, int]
) -> None:
    """Draws a disc into a part of the table whose upper left pixel is `corner`."""
    fine = 4  # sub-pixel places: a round number of pixels would hide small errors
    x = (place_m[0] + _SIDE_M / 2) * PX_PER_M - corner[0]
    y = (_SIDE_M / 2 - place_m[1]) * PX_PER_M - corner[1]
    centre = (round(x * 2**fine), round(y * 2**fine))
    cv2.circle(scene, centre, round(radius_m * PX_PER_M * 2**fine), rgb, -1, cv2.LINE_AA, fine)


@cache
def _table(tags: bool) -> np.ndarray:
    """The table top: grain, seams, and things that are always there."""
    rng = np.random.default_rng(12)
    side = round(_SIDE_M * PX_PER_M)
    grain = cv2.GaussianBlur(rng.normal(0, 60, (side, side)).astype(np.float32), (0, 0), 6)
    base = 178 + 3 * grain + np.linspace(-10, 10, side, dtype=np.float32)[None]
    scene = np.clip(np.stack([base + 8, base - 6, base - 28], -1), 0, 255).astype(np.uint8)
    for row in range(0, side, 125):
        cv2.line(scene, (0, row), (side, row), (120, 104, 84), 2)
    for _ in range(40):
        place = rng.integers(0, side, 2)
        ends = place + rng.integers(8, 40, 2)
        grey = int(rng.integers(60, 235))
        cv2.rectangle(scene, place.tolist(), ends.tolist(), (grey, grey, grey - 20), -1)
    for goal in GOALS_M:
        cv2.circle(scene, _pixel(goal), round(0.1 * PX_PER_M), GOAL_RGB, 5, cv2.LINE_AA)
    if tags:
        _tag(scene, np.zeros(2, int), np.array(_TABLE_TAG_M), 1)
    return scene


def _tag(scene: np.ndarray, corner: np.ndarray, place_m: np.ndarray, number: int) -> None:
    """Draws an ArUco tag (4x4_50) with its white border, centred on a place, as far as it is in the scene."""
    side = round(TAG_SIDE_M * PX_PER_M)
    marker = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), number, side
    )
    bordered = cv2.copyMakeBorder(marker, 6, 6, 6, 6, cv2.BORDER_CONSTANT, value=255)
    column, row = np.array(_pixel(place_m)) - corner
    top, left = row - bordered.shape[0] // 2, column - bordered.shape[1] // 2
    inside = bordered[max(-top, 0) :, max(-left, 0) :]
    place = scene[max(top, 0) : max(top + len(bordered), 0), max(left, 0) : max(left + len(bordered), 0)]
    place[:] = inside[: place.shape[0], : place.shape[1], None]
