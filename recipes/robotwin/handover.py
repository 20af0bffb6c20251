"""How the scripted controller hands a standing box from one arm to the other and sets it down."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from recipes.robotwin.expert import UP, BlockExpert

BEFORE_M = 0.11
"""How far in front of a box open fingers wait."""
GRASPS_M = {"left": 0.05, "right": -0.045}
"""Where the arms hold the box, above its centre: one above the other."""
PASSING_M = (-0.03, -0.03, 0.92)
"""Where the box's centre is while both arms hold it."""
PASSING_TO = np.array([0.5, 0.87, 0.0])
"""Where the left gripper points then; the right one comes at right angles to it."""
_TURNS = np.deg2rad([0, 20, -20, 40, -40, 60, -60])
_LEVEL = 0.95
"""Vertical part of the axis of a box that stands."""


def grasp(
    expert: BlockExpert, side: str, name: str, height_m: float, across: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Actions that grasp a standing box from the side.

    Args:
        expert: drives.
        side: which arm.
        name: of the box.
        height_m: of the grasp, above the box's centre.
        across: (3,) direction to which the approach shall be at right angles: another arm's.

    Raises:
        RuntimeError: the box lies, or is out of reach.
    """
    yield from grasp_open(expert, side, name, height_m, across)
    yield from expert.grip(side, 0.0)


def grasp_open(
    expert: BlockExpert,
    side: str,
    name: str,
    height_m: float,
    across: np.ndarray | None = None,
    miss_m: float = 0.0,
) -> Iterator[np.ndarray]:
    """`grasp`, but for the closing of the fingers.

    Args:
        expert: drives.
        side: which arm.
        name: of the box.
        height_m: of the grasp, above the box's centre.
        across: (3,) direction to which the approach shall be at right angles.
        miss_m: by which the fingers miss the box to one side, for experts that shall fail.
    """
    position, rotation = expert.body(name)
    if abs(rotation[2, 2]) < _LEVEL:
        raise RuntimeError(f"{name} does not stand")
    reach = position - expert.shoulder(side)
    faces = []
    for axis in (rotation[:, 0], rotation[:, 1], -rotation[:, 0], -rotation[:, 1]):
        flat = np.array([axis[0], axis[1], 0.0])
        faces.append(flat / np.linalg.norm(flat))
    if across is not None:
        faces = sorted(faces, key=lambda face: abs(float(face @ across)))[:2]
    approach = max(faces, key=lambda face: float(face @ reach))
    now = expert.fingertips(side)[:3, :3] @ expert.closing(side)
    closing = max((np.cross(UP, approach), -np.cross(UP, approach)), key=lambda c: float(c @ now))
    turned = expert.facing(side, approach, closing)
    at = position + height_m * UP + miss_m * closing
    if expert.opening(side) < 0.9:
        yield from expert.grip(side, 1.0)
    yield from expert.move(side, at - BEFORE_M * approach, turned)
    yield from expert.move(side, at, turned)


def carry(
    expert: BlockExpert, side: str, name: str, target: np.ndarray, towards: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Actions that bring a held box's centre to `target` (3,) metres.

    Args:
        expert: drives.
        side: which arm.
        name: of the box.
        target: of its centre.
        towards: (3,) direction that the gripper shall point to, as nearly as the arm can; None keeps it.

    Raises:
        RuntimeError: out of reach.
    """
    tcp = expert.fingertips(side)
    offset = expert.body(name)[0] - tcp[:3, 3]
    refusal: RuntimeError | None = None
    wanted = tcp[:3, 0] if towards is None else towards
    first = np.arctan2(wanted[1], wanted[0]) - np.arctan2(tcp[1, 0], tcp[0, 0])
    for angle in first + _TURNS:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        try:
            yield from expert.move(side, target - turn @ offset, turn @ tcp[:3, :3])
            return
        except RuntimeError as err:
            refusal = err
    raise refusal


def pass_over(expert: BlockExpert, name: str) -> Iterator[np.ndarray]:
    """Actions that bring the box from the table into the right gripper."""
    yield from grasp(expert, "left", name, GRASPS_M["left"])
    yield from carry(expert, "left", name, expert.body(name)[0] + 0.05 * UP)
    yield from carry(expert, "left", name, np.array(PASSING_M), PASSING_TO)
    yield from grasp(expert, "right", name, GRASPS_M["right"], across=expert.fingertips("left")[:3, 0])
    yield from expert.grip("left", 1.0)
    yield from expert.retreat("left")
    yield from expert.go_home("left")


def take(expert: BlockExpert, name: str) -> Iterator[np.ndarray]:
    """Actions that bring the box into the right gripper, from wherever it stands, and lift it."""
    if expert.body(name)[0][0] < 0:
        yield from pass_over(expert, name)
    else:
        yield from grasp(expert, "right", name, GRASPS_M["left"])
    yield from carry(expert, "right", name, expert.body(name)[0] + 0.05 * UP)


def set_down(expert: BlockExpert, name: str, target: np.ndarray) -> Iterator[np.ndarray]:
    """Actions that stand a box, held by the right arm, at `target` (3,) metres, and let go."""
    yield from carry_down(expert, name, target)
    yield from expert.grip("right", 1.0)
    yield from expert.retreat("right")


def carry_down(expert: BlockExpert, name: str, target: np.ndarray) -> Iterator[np.ndarray]:
    """Actions that bring a box, held by the right arm, down to `target` (3,) metres."""
    yield from carry(expert, "right", name, target + 0.06 * UP, target - expert.shoulder("right"))
    yield from carry(expert, "right", name, target)
