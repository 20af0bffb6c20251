"""RoboTwin's robot, from the files of its embodiment: where its arms reach, and whether it is the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml

from lerobot_roborecover.platforms.robot_fingerprint import LIMIT_MM, robot_entries
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.platforms.urdf import Urdf

SIDES = ("left", "right")
SETTINGS: dict[str, tuple[float, ...]] = {
    "1": (0.3, 0.9, 0.7, -0.4, 0.2, 0.5),
    "2": (-0.5, 1.4, 1.1, 0.6, -0.3, -1.0),
    "3": (0.8, 0.5, 1.6, -1.1, 0.7, 1.2),
}
"""Values of an arm's six joints, the same for both arms, at which robots are compared."""
RELEASED_ENDS_M: dict[str, tuple[float, float, float]] = {
    "left": (-0.2979237, -0.3138039, 0.9419986),
    "right": (0.3064331, -0.3127998, 0.9409984),
}
"""Where the wrists of the paper's robot are with all joints at 0: `initial_state` of the RoboTwin example in
the paper's public repository (https://github.com/CuteClaire/RoboRecover)."""
_ROBOT_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class RobotwinRobot:
    """An embodiment of two arms.

    Args:
        folder: of the embodiment, with its `config.yml`.

    Raises:
        SimulatorError: the configuration or the URDF cannot be used.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        try:
            self._config = yaml.safe_load((folder / "config.yml").read_text(encoding="utf-8"))
            self.urdf = Urdf(folder / str(self._config["urdf_path"]))
            self._arms = dict(zip(SIDES, self._config["arm_joints_name"], strict=True))
            x, y, z, *wxyz = np.ravel(self._config.get("robot_pose", _ROBOT_POSE))[:7]
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as err:
            raise SimulatorError(
                f"RoboTwin's robot {folder}: config.yml cannot be used ({err}). Put the original "
                "embodiment in its place"
            ) from err
        self._root = np.eye(4)
        self._root[:3, :3], self._root[:3, 3] = _rotation(wxyz), (x, y, z)

    def end(self, side: str, values: Sequence[float]) -> np.ndarray:
        """(4, 4): world pose of an arm's last link.

        Args:
            side: `left` or `right`.
            values: of the arm's joints, radians.
        """
        names = self._arms[side]
        return self._root @ self.urdf.pose(names[-1], dict(zip(names, values, strict=False)))

    @cached_property
    def fingerprint(self) -> dict[str, str]:
        """Entries of a handoff's fingerprint."""
        ends = {
            f"{side}.{name}": self.end(side, values) for side in SIDES for name, values in SETTINGS.items()
        }
        return robot_entries(self.folder.name, ends, self.urdf.kinematics_sha256(), self.urdf.mesh_hashes())

    def from_released_mm(self) -> dict[str, float]:
        """How far each wrist is from the paper's, with all joints at 0, by side."""
        return self.from_recorded_mm(RELEASED_ENDS_M)

    def from_recorded_mm(self, wrists_m: Mapping[str, Sequence[float]]) -> dict[str, float]:
        """How far each wrist is, with all joints at 0, from where a record has it, by side.

        Args:
            wrists_m: (3,) or more by side; RoboTwin's `endpose` begins with the position.
        """
        home = {side: self.end(side, [0.0] * len(self._arms[side]))[:3, 3] for side in SIDES}
        return {
            side: float(np.linalg.norm(home[side] - np.asarray(wrists_m[side][:3], dtype=np.float64))) * 1e3
            for side in SIDES
        }


def another_robot(found_mm: dict[str, float]) -> str:
    """What is wrong with a robot whose wrists are that far from a record's, or nothing where they are not."""
    off = [f"its {side} wrist is {mm:.2f} mm away" for side, mm in found_mm.items() if not mm <= LIMIT_MM]
    return "" if not off else f"with all joints at 0 {' and '.join(off)} (limit {LIMIT_MM:g} mm)"


def _rotation(wxyz: Sequence[float]) -> np.ndarray:
    """(3, 3) of a quaternion, which RoboTwin's configuration gives with three digits."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
