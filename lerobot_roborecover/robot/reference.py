"""What a camera has recorded of a recovery point, and whether the camera has moved since."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

CHANGED = 18.0
"""Grey levels by which a pixel has changed while the episode was recorded, after smoothing."""
_MIN_STATIC = 0.15
"""Least share of a picture that has to be static background."""
_BORDER = 0.06
"""Share of a picture's sides that no match may lean on: a shift brings in what the other does not show."""
_MAX_ORB_RESIDUAL_PX = 1.5
_MIN_STATIC_PX = 12


@dataclass(frozen=True)
class Reference:
    """A camera's recorded picture at the recovery point, with what its episode tells of each pixel."""

    picture: np.ndarray
    """(H, W, 3) uint8."""
    static: np.ndarray
    """(H, W) bool: background that did not change."""
    objects: np.ndarray
    """(H, W) bool: foreground of the recovery point, or what people have drawn."""
    background: np.ndarray | None = None
    """(H, W, 3) uint8: median of the episode's moments; None of one moment alone."""
    drawn: bool = False
    """People have drawn `objects`."""
    cleared: np.ndarray | None = None
    """(H, W, 3) uint8: the arm as in `picture`, and no objects; None where the table was not cleared."""
    arm: np.ndarray | None = None
    """(H, W) bool: where the arm stands in `cleared`."""

    @classmethod
    def of(cls, frames: np.ndarray) -> Reference:
        """From moments of an episode.

        Args:
            frames: (K, H, W, 3) uint8, the recovery point last. With one frame alone, everything is taken
                for background and object at once.
        """
        picture = frames[-1]
        if len(frames) < 2:
            whole = np.ones(picture.shape[:2], bool)
            return cls(picture, whole, whole)
        smooth = np.stack([cv2.GaussianBlur(_grey(f), (0, 0), 1.5) for f in frames])
        changed = (smooth.max(0) - smooth.min(0)) > CHANGED
        changed = cv2.dilate(changed.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        static = ~changed
        if static.mean() < _MIN_STATIC:  # a wrist camera: all of its background moved with the arm
            static = np.ones_like(static)
        # The arm is part of the foreground, too: at the same joints it has not shifted, and does no harm.
        foreground = np.abs(smooth[-1] - np.sort(smooth, axis=0)[len(smooth) // 2]) > CHANGED
        objects = cv2.dilate(foreground.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        background = np.median(frames, 0).astype(np.uint8)
        return cls(picture, static, objects if objects.any() else changed, background)

    def with_boxes(self, boxes: list[tuple[int, int, int, int]]) -> Reference:
        """The same with object regions that a person has drawn.

        Args:
            boxes: left, top, width, height in pixels.
        """
        objects = np.zeros_like(self.objects)
        for left, top, width, height in boxes:
            objects[top : top + height, left : left + width] = True
        return replace(self, objects=objects, static=self.static & ~objects, drawn=True)

    def with_cleared(self, before: np.ndarray, live: np.ndarray) -> Reference:
        """The same with pictures of the cleared table.

        Args:
            before: (H, W, 3) uint8, with the arm elsewhere.
            live: (H, W, 3) uint8, with the arm where it was.
        """
        elsewhere, cleared = (aligned(p, background_shift(self, p)) for p in (before, live))
        arm = differ(cleared, elsewhere, 0.5, 2 * CHANGED)
        if self.background is not None:  # where the arm stood before, the table looks as in the episode
            arm &= differ(cleared, self.background, 0.5, 2 * CHANGED)
        return replace(self, cleared=cleared, arm=arm)


def background_shift(reference: Reference, live: np.ndarray) -> tuple[float, float] | None:
    """Columns and rows by which the static background has shifted; None where it has too little structure.

    Features that agree on one shift give it where it is large; phase correlation refines it to parts of a
    pixel.
    """
    coarse = _feature_shift(reference, live)
    if coarse is None:
        coarse = (0.0, 0.0)
    start = np.round(coarse)
    moved = _moved(live, (-float(start[0]), -float(start[1])))
    mask = _inner(reference.static, np.abs(start).max())
    if mask.sum() < _MIN_STATIC_PX:
        return None
    one, other = _grey(reference.picture), _grey(moved)
    if one[mask].std() < 2.0:
        return None
    # Masked pixels are set to the mean of both: an edge at the same place in both pictures would vote for
    # no shift.
    weight = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0) * mask
    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    parts = [(g - float(g[mask].mean())) * weight for g in (one, other)]
    (column, row), response = cv2.phaseCorrelate(*parts, window)
    if response < 0.02:
        return None
    fine = _refined(parts[0], parts[1], (column, row))
    return float(start[0] + fine[0]), float(start[1] + fine[1])


def _refined(one: np.ndarray, other: np.ndarray, start: tuple[float, float]) -> tuple[float, float]:
    """The shift that least squares find next to a start (`cv2.findTransformECC` without its scaling)."""
    shift = np.array(start, float)
    for _ in range(8):
        moved = _moved(other, (-float(shift[0]), -float(shift[1])))
        rows, columns = np.gradient(moved)
        inner = _inner(np.ones(one.shape, bool), np.abs(shift).max())
        gradient = np.stack([columns[inner], rows[inner]], 1)
        # moved(x) is other(x + shift); a small error d of the shift changes it by gradient . d
        step, *_ = np.linalg.lstsq(gradient, (one - moved)[inner], rcond=None)
        if not np.isfinite(step).all() or np.abs(step).max() > 2.0:
            return start
        shift += step
        if np.abs(step).max() < 0.01:
            break
    return (float(shift[0]), float(shift[1])) if np.hypot(*(shift - start)) < 2.0 else start


def _feature_shift(reference: Reference, live: np.ndarray) -> tuple[float, float] | None:
    """The shift on which most matched features agree; None where too few do."""
    orb = cv2.ORB.create(nfeatures=400, fastThreshold=8, edgeThreshold=12, patchSize=21)
    mask = reference.static.astype(np.uint8)
    points, found = orb.detectAndCompute(_grey(reference.picture).astype(np.uint8), mask)
    others, seen = orb.detectAndCompute(_grey(live).astype(np.uint8), None)
    if found is None or seen is None or len(points) < 4 or len(others) < 4:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(found, seen)
    if len(matches) < 6:
        return None
    gaps = np.array([np.subtract(others[m.trainIdx].pt, points[m.queryIdx].pt) for m in matches])
    near = np.abs(gaps[:, None] - gaps[None]).max(-1) < _MAX_ORB_RESIDUAL_PX
    best = int(near.sum(1).argmax())
    if near[best].sum() < max(6, 0.2 * len(matches)):
        return None
    column, row = np.median(gaps[near[best]], 0)
    return float(column), float(row)


def differ(one: np.ndarray, other: np.ndarray, blur_px: float, levels: float) -> np.ndarray:
    """(H, W) bool: where two pictures differ by more than so many levels in a colour, after smoothing."""
    smooth = (cv2.GaussianBlur(p.astype(np.float32), (0, 0), blur_px) for p in (one, other))
    return np.abs(np.subtract(*smooth)).max(-1) > levels


def _grey(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _moved(picture: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """A picture shifted by columns and rows."""
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (picture.shape[1], picture.shape[0])
    return cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def aligned(picture: np.ndarray, shift: tuple[float, float] | None) -> np.ndarray:
    """A live picture without the camera's shift, where one was measured."""
    return picture if shift is None else _moved(picture, (-shift[0], -shift[1]))


def _inner(mask: np.ndarray, shift_px: float) -> np.ndarray:
    """A mask without the pixels near the border that a shift replaces."""
    edge = int(np.ceil(shift_px)) + max(round(_BORDER * min(mask.shape)), 1)
    inner = np.zeros_like(mask)
    inner[edge:-edge, edge:-edge] = mask[edge:-edge, edge:-edge]
    return inner
