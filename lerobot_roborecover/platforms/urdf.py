"""A robot's URDF as far as it moves and collides: forward kinematics and hashes, without a simulator."""

from __future__ import annotations

import hashlib
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_roborecover.platforms.simulator import SimulatorError

MISSING = "missing"
"""In place of the hash of a mesh that is not there."""
_MOVING = ("revolute", "continuous", "prismatic")
_DIGITS = 9
"""Decimals to which two URDFs' numbers count as equal, whatever their spelling."""


@dataclass(frozen=True)
class Joint:
    name: str
    kind: str
    """`revolute`, `continuous`, `prismatic`, `fixed`, ..."""
    parent: str
    child: str
    origin: np.ndarray
    """(4, 4): the child's frame in the parent's, with the joint at 0."""
    axis: np.ndarray
    """(3,) unit vector in the child's frame."""
    limits: tuple[float, ...]
    """Lower and upper limit, radians or metres; empty where there is none."""


class Urdf:
    """A URDF file.

    Args:
        path: the file.

    Raises:
        SimulatorError: it cannot be read, or is no URDF.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            root = ElementTree.fromstring(path.read_bytes())
            joints = [_joint(element) for element in root.iter("joint") if element.find("child") is not None]
        except (OSError, ElementTree.ParseError, KeyError, ValueError, AttributeError) as err:
            raise SimulatorError(
                f"the robot's URDF {path} cannot be read ({err}). Put the original file in its place"
            ) from err
        self.joints = {joint.name: joint for joint in joints}
        self._above = {joint.child: joint for joint in joints}
        meshes = {mesh.get("filename", "") for found in root.iter("collision") for mesh in found.iter("mesh")}
        self._meshes = sorted(meshes - {""})

    def pose(self, joint: str, values: Mapping[str, float]) -> np.ndarray:
        """(4, 4): a joint's child link in the frame of the robot's root.

        Args:
            joint: name of the joint.
            values: of the joints that are not at 0, radians or metres.

        Raises:
            SimulatorError: the URDF has no such joint, or its joints go round in a circle.
        """
        at = self.joints.get(joint)
        if at is None:
            raise SimulatorError(f"the robot's URDF {self.path} has no joint {joint!r}")
        pose, link = np.eye(4), at.child
        for _ in range(len(self._above) + 1):
            above = self._above.get(link)
            if above is None:
                return pose
            pose = above.origin @ _motion(above, values.get(above.name, 0.0)) @ pose
            link = above.parent
        raise SimulatorError(f"the robot's URDF {self.path}: the joints above {joint!r} form a circle")

    def kinematics_sha256(self) -> str:
        """Hash of all joints: names, kinds, links, origins, axes and limits; no formatting, no looks."""
        digest = hashlib.sha256()
        for name in sorted(self.joints):
            joint = self.joints[name]
            numbers = [*joint.origin[:3].ravel(), *joint.axis, *joint.limits]
            text = [
                f"{value:.{_DIGITS}f}".replace(f"-{0:.{_DIGITS}f}", f"{0:.{_DIGITS}f}") for value in numbers
            ]
            digest.update(" ".join([name, joint.kind, joint.parent, joint.child, *text, "\n"]).encode())
        return digest.hexdigest()

    def mesh_hashes(self) -> dict[str, str]:
        """SHA-256 of every mesh that collides, by its file's name; `missing` where it is not there."""
        found = {}
        for name in self._meshes:
            file = (self.path.parent / name.removeprefix("package://")).resolve()
            found[file.name] = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else MISSING
        return found


def _joint(element: ElementTree.Element) -> Joint:
    origin, axis, limit = element.find("origin"), element.find("axis"), element.find("limit")
    direction = _numbers(axis.get("xyz", "1 0 0")) if axis is not None else np.array([1.0, 0.0, 0.0])
    limits = () if limit is None else tuple(float(limit.get(end, 0)) for end in ("lower", "upper"))
    pose = np.eye(4)
    if origin is not None:
        pose[:3, :3] = _rpy(*_numbers(origin.get("rpy", "0 0 0")))
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    return Joint(
        name=element.attrib["name"],
        kind=element.attrib["type"],
        parent=_link(element, "parent"),
        child=_link(element, "child"),
        origin=pose,
        axis=direction / max(float(np.linalg.norm(direction)), 1e-12),
        limits=limits,
    )


def _link(joint: ElementTree.Element, which: str) -> str:
    found = joint.find(which)
    if found is None:
        raise ValueError(f"joint {joint.get('name')!r} has no {which}")
    return found.attrib["link"]


def _numbers(text: str) -> np.ndarray:
    """(3,) float64 of an attribute."""
    values = np.array([float(part) for part in text.split()])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"{text!r} is not three numbers")
    return values


def _rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """(3, 3): URDF's fixed-axis roll, pitch, yaw, radians."""
    x, y, z = (_about(axis, angle) for axis, angle in zip(np.eye(3), (roll, pitch, yaw), strict=True))
    return z @ y @ x


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3): rotation about a unit axis, radians."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _motion(joint: Joint, value: float) -> np.ndarray:
    """(4, 4): what a joint's value does to its child's frame."""
    moved = np.eye(4)
    if joint.kind == "prismatic":
        moved[:3, 3] = value * joint.axis
    elif joint.kind in _MOVING:
        moved[:3, :3] = _about(joint.axis, value)
    return moved
