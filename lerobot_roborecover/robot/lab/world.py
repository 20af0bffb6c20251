"""What the lab's robot stands in: a contract, and the table of the point-mass simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from lerobot_roborecover.platforms.fake.simulator import FAKE_TASKS, FakeSimulator
from lerobot_roborecover.robot.lab.table_camera import TableCamera
from lerobot_roborecover.scenario import Reset, ScenarioError, Task

type Truth = dict[str, list[float]]
"""Places of all objects by name, in the world's own numbers; only the simulated operator may see them."""


class World(Protocol):
    """A scene with a robot that follows position targets."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names without `.pos`."""

    @property
    def units(self) -> Mapping[str, str]:
        """By joint."""

    @property
    def limits(self) -> Mapping[str, tuple[float, float]]:
        """Calibrated range by joint."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names."""

    @property
    def tasks(self) -> Mapping[str, str]:
        """Instruction by task name."""

    def reset(self, task: str, seed: int) -> None:
        """Lays out a new scene."""

    def step(self, target: np.ndarray) -> None:
        """Moves towards a position target, (J,), for one control step."""

    def positions(self) -> np.ndarray:
        """(J,) joint positions."""

    def image(self, camera: str) -> np.ndarray:
        """(H, W, 3) uint8."""

    def bump(self, camera: str, shift_px: tuple[float, float]) -> None:
        """Moves a camera so that its picture shifts by so many columns and rows."""

    def succeeded(self) -> bool:
        """Whether the task is done, as a person would say who looks."""

    def truth(self) -> Truth:
        """Where the objects are."""

    def boxes(self, camera: str) -> list[list[int]]:
        """Left, top, width and height around the objects in a picture, as a person would draw them."""

    def clear(self) -> None:
        """Takes the objects off the table."""

    def place(self, truth: Truth, offset_m: np.ndarray, turn_rad: float) -> None:
        """Puts the objects where they were, off by (2,) metres along the table and a turn."""

    def distance_m(self, truth: Truth) -> float:
        """Largest distance of an object from where it was."""

    def close(self) -> None:
        """Frees the simulator."""


class TableWorld:
    """A point mass as the gripper, a puck, two goals; joints are its two positions in millimetres.

    Args:
        size: rows and columns of a picture.
        tags: draw a fiducial tag on the puck and one on the table.
    """

    joints = ("x", "y")
    units = dict.fromkeys(("x", "y"), "mm")
    limits = dict.fromkeys(("x", "y"), (-450.0, 450.0))
    cameras = ("top", "wrist")
    tasks = FAKE_TASKS["toy"]
    _AWAY = (0.95, 0.95)
    _GAIN = 10.0

    def __init__(self, size: int = 96, tags: bool = False):
        self._simulator = FakeSimulator()
        self._cameras = {
            "top": TableCamera(size, 1.0, tags=tags),
            "wrist": TableCamera(size, 0.5, follows=True, tags=tags),
        }
        self._task = ""

    def reset(self, task: str, seed: int) -> None:
        if task not in self.tasks:
            raise ScenarioError(f"--robot.task={task!r:.40}: the table has {', '.join(self.tasks)}")
        self._task = task
        self._simulator.reset(Task("fake", "toy", task, self.tasks[task], 60), Reset(seed=seed))

    def step(self, target: np.ndarray) -> None:
        """Moves towards a position target in millimetres."""
        gap_m = np.asarray(target, float) / 1000 - self._simulator.bodies()["eef"].position_m[:2]
        self._simulator.step(np.clip(self._GAIN * gap_m, -1.0, 1.0))

    def positions(self) -> np.ndarray:
        """(2,) millimetres."""
        return 1000 * np.array(self._simulator.bodies()["eef"].position_m[:2])

    def image(self, camera: str) -> np.ndarray:
        """(size, size, 3) uint8."""
        poses = self._simulator.bodies()
        hand, puck = (np.array(poses[name].position_m[:2]) for name in ("eef", "puck"))
        return self._cameras[camera].picture(hand, puck)

    def bump(self, camera: str, shift_px: tuple[float, float]) -> None:
        self._cameras[camera].shift_px = np.asarray(shift_px, float)

    def succeeded(self) -> bool:
        """Whether the puck is in the goal."""
        return self._simulator.succeeded()

    def truth(self) -> Truth:
        """Where the puck is, metres."""
        return {"puck": [float(v) for v in self._simulator.bodies()["puck"].position_m[:2]]}

    def boxes(self, camera: str) -> list[list[int]]:
        """Around the puck, where the camera sees it."""
        poses = self._simulator.bodies()
        hand, puck = (np.array(poses[name].position_m[:2]) for name in ("eef", "puck"))
        return self._cameras[camera].box(hand, puck)

    def clear(self) -> None:
        """Puts the puck far from everything."""
        self._set_puck(np.array(self._AWAY))

    def place(self, truth: Truth, offset_m: np.ndarray, turn_rad: float) -> None:
        """Puts the puck back; it is round."""
        self._set_puck(np.array(truth["puck"]) + offset_m)

    def distance_m(self, truth: Truth) -> float:
        return float(np.linalg.norm(np.subtract(self.truth()["puck"], truth["puck"])))

    def close(self) -> None:
        self._simulator.close()

    def _set_puck(self, position_m: np.ndarray) -> None:
        state = np.frombuffer(self._simulator.snapshot()[:-8]).copy()
        state[4:6] = position_m
        self._simulator.restore(state.tobytes() + (0).to_bytes(8, "little"))
