"""Which robot a simulator has, as entries of its fingerprint, and in what two robots differ.

A robot whose arms are mounted elsewhere gives other states from the same actions. A handoff would then end as
`state_mismatch`, trial by trial, with nothing in it that says why; so robots are compared first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.platforms.urdf import MISSING

NAME, KINEMATICS, REACH, MESH = "robot", "robot_kinematics", "robot_fk.", "robot_mesh."
"""Entries of a fingerprint: `robot_fk.<end>.<setting>` is a pose, `robot_mesh.<file>` a hash."""
LIMIT_MM = 0.1
"""Between the end effectors of two robots that count as one. The robot of the paper's release and the one of
the shipped set are 0.0053 mm apart, two models of one arm with other mounts 5 to 8 mm."""
LIMIT_RAD = 1e-3
_SHORT = 16


def robot_entries(
    name: str,
    ends: Mapping[str, np.ndarray],
    kinematics_sha256: str,
    mesh_sha256: Mapping[str, str],
) -> dict[str, str]:
    """A robot as entries of a fingerprint.

    Args:
        name: what the platform calls it.
        ends: (4, 4) world poses by `<end effector>.<joint setting>`.
        kinematics_sha256: of the joints.
        mesh_sha256: by file, of what collides.
    """
    entries = {NAME: name, KINEMATICS: kinematics_sha256[:_SHORT]}
    for key, pose in ends.items():
        numbers = np.concatenate([pose[:3, 3], pose[:3, :2].T.ravel()])
        entries[REACH + key] = " ".join(f"{value + 0.0:.7f}" for value in numbers)
    return entries | {MESH + file: digest[:_SHORT] for file, digest in mesh_sha256.items()}


def is_robot_entry(key: str) -> bool:
    """Whether an entry of a fingerprint is about the robot."""
    return key in (NAME, KINEMATICS) or key.startswith((REACH, MESH))


@dataclass(frozen=True)
class RobotComparison:
    """Two robots, the recorded one and the one here."""

    known: bool
    """Whether both fingerprints have a robot; without that there is nothing to compare."""
    elsewhere: tuple[str, ...] = ()
    """End effectors that are elsewhere at the same joint values, worst first, in words. Such a robot gives
    other states."""
    shapes: tuple[str, ...] = ()
    """Other joints or meshes, in words: whether they matter, the check of every handoff decides."""

    @property
    def another(self) -> bool:
        """Whether nothing recorded on the one holds on the other."""
        return bool(self.elsewhere)

    def __str__(self) -> str:
        return "; ".join((*self.elsewhere, *self.shapes)) or "the same robot"


SAME = RobotComparison(known=True)


def compare_robots(recorded: Mapping[str, str], here: Mapping[str, str]) -> RobotComparison:
    """Compares the robots of two fingerprints.

    Args:
        recorded: fingerprint of a scenario.
        here: fingerprint of this machine's simulator.
    """
    shared = [key for key in recorded if key.startswith(REACH) and key in here]
    if not shared:
        return RobotComparison(known=False)
    elsewhere = []
    for key in shared:
        distance_mm, angle_rad = _apart(recorded[key], here[key])
        if not (distance_mm <= LIMIT_MM and angle_rad <= LIMIT_RAD):
            end, _, setting = key.removeprefix(REACH).partition(".")
            elsewhere.append(
                (
                    distance_mm,
                    f"its {end} end is {distance_mm:.2f} mm and {angle_rad:.4f} rad elsewhere at joint "
                    f"setting {setting}",
                )
            )
    shapes = []
    if recorded.get(KINEMATICS) != here.get(KINEMATICS):
        shapes.append(f"its joints' hash is {here.get(KINEMATICS)}, not {recorded.get(KINEMATICS)}")
    for key in sorted({k for k in (*recorded, *here) if k.startswith(MESH)}):
        was, found = recorded.get(key, MISSING), here.get(key, MISSING)
        # A mesh that only one of the two has is of a part that nothing touched, or that one of them left out.
        if was != found and MISSING not in (was, found):
            shapes.append(f"its mesh {key.removeprefix(MESH)} is {found}, not {was}")
    words = [text for _, text in sorted(elsewhere, key=lambda found: -found[0])]
    return RobotComparison(True, tuple(words), tuple(shapes))


def _apart(one: str, other: str) -> tuple[float, float]:
    """Millimetres and radians between two poses; infinite where one is unreadable."""
    try:
        a, b = (np.array([float(part) for part in text.split()]) for text in (one, other))
        if a.shape != (9,) or b.shape != (9,):
            raise ValueError
    except ValueError:
        return np.inf, np.inf
    columns = np.linalg.norm((a - b)[3:].reshape(2, 3), axis=1)
    return float(np.linalg.norm((a - b)[:3])) * 1e3, float(2 * np.arcsin(min(columns.max() / 2, 1.0)))
