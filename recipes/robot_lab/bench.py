"""The study's robot, policies and recovery points, and a trial from an exact start."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.robot.points import PointSet, RobotPoint, read_points

FPS = 20
LIMIT_S = 6.0
SIZE = 96
MM_PER_PX = 1000.0 / SIZE
"""Of the camera above, which sees a metre."""
POLICIES = {"bias_40": 40.0, "bias_45": 45.0}
"""Millimetres by which the policy misjudges where the puck is."""
SOURCE_BIAS_MM = 55.0
"""Of the policy whose rollouts the recovery points are taken from."""
FIRST_SCENE = 100
POINTS, MAX_EPISODES = 40, 120
_MOVED_MM, _STILL_FRAMES, _STILL_MM = 10.0, 5, 0.1


def lab_config(folder: Path, **options: Any) -> Any:
    """Configuration of a lab whose time goes on with its steps."""
    from lerobot_roborecover.robot.lab.config_lab_robot import LabRobotConfig

    values = {"size": SIZE, "seed": FIRST_SCENE, "realtime": False, **options}
    return LabRobotConfig(id="lab", calibration_dir=folder, **values)


@contextmanager
def lab(folder: Path, **options: Any) -> Generator[Any]:
    """A connected lab."""
    from lerobot_roborecover.robot.connection import connected

    with connected(lab_config(folder, **options)) as robot:
        yield robot


def policy(out: Path, name: str, bias_mm: float, size: int = SIZE) -> str:
    """Checkpoint of a scripted policy; written once."""
    from lerobot_roborecover.robot.lab.scripted import save_scripted

    folder = out / "policies" / name
    if not folder.exists():
        save_scripted(folder, size=size, bias_mm=bias_mm)
    return str(folder)


@dataclass(frozen=True)
class Bench:
    """One camera set-up: where its recordings are, and what the lab is configured with."""

    out: Path
    options: dict[str, Any]
    count: int = POINTS

    def lab(self) -> Any:
        """A connected lab of this set-up."""
        return lab(self.out, **self.options)

    @cached_property
    def points(self) -> PointSet:
        """Recovery points of a biased policy's rollouts, each of another scene; captured and made once."""
        if not (self.out / "points" / "meta").exists():
            self._make_points()
        return read_points(self.out / "points")

    def _make_points(self) -> None:
        from lerobot_roborecover.robot.capture import capture
        from lerobot_roborecover.robot.console import Console
        from lerobot_roborecover.robot.episodes import Episodes, PointRequest
        from lerobot_roborecover.robot.points import write_points
        from lerobot_roborecover.robot.policies import load_context
        from lerobot_roborecover.robot.recorder import truths

        size = self.options.get("size", SIZE)
        source = policy(self.out, "source", SOURCE_BIAS_MM, size)
        recorded, made = self.out / "rollouts", []
        with self.lab() as robot:
            context = load_context(robot, source, fps=FPS, instruction=robot.instruction)
            robot.new_scene(FIRST_SCENE)
            episode = 0
            while len(made) < self.count and episode < MAX_EPISODES:
                if not _recorded(recorded, episode):
                    robot.new_scene(FIRST_SCENE + episode)
                    capture(
                        robot, context, recorded, Console(_Watches()), episodes=1, limit_s=LIMIT_S,
                        instruction=robot.instruction, say=lambda line: None,
                    )  # fmt: skip
                if (frame := moment(truths(recorded, episode))) is not None:
                    made.append((episode, frame))
                episode += 1
        episodes = Episodes(recorded)
        found = [
            episodes.point(
                PointRequest(e, f, "Move", "Wrong Pose", source_policy="source", quasi_static=True), LIMIT_S
            )
            for e, f in made
        ]
        print(f"{len(found)} points from {episode} episodes in {self.out / 'points'}", flush=True)
        write_points(self.out / "points", [s for s, _ in found], {s.id: p for s, p in found})


class _Watches:
    """Starts every episode, and presses nothing while it runs."""

    def answer(self, screen: str, details: dict[str, Any]) -> Any:
        """What is pressed on a screen."""
        from lerobot_roborecover.robot.console import Answer

        return Answer("go") if screen == "next" else None


def _recorded(root: Path, episode: int) -> bool:
    from lerobot_roborecover.robot.recorder import truths

    return bool(truths(root, episode))


def moment(frames: list[dict[str, Any]]) -> int | None:
    """The recovery point of an episode: the first frame at which the puck was pushed, lies still and is not
    in the goal; None where there is none.

    Args:
        frames: the lab's own state at every frame.
    """
    pucks = 1000 * np.array([f["objects"]["puck"] for f in frames])
    for frame in range(_STILL_FRAMES, len(frames)):
        moved = np.linalg.norm(pucks[frame] - pucks[0]) > _MOVED_MM
        still = np.abs(pucks[frame - _STILL_FRAMES : frame + 1] - pucks[frame]).max() < _STILL_MM
        if moved and still and not frames[frame]["solved"]:
            return frame
    return None


def replay(robot: Any, point: RobotPoint) -> None:
    """Puts the lab exactly where it was at a point: the episode's scene, and its recorded actions.

    Raises:
        AssertionError: the puck is not exactly where it was.
    """
    robot.new_scene(FIRST_SCENE + point.episode)
    for action in point.scenario.prefix:
        robot.send_action(dict(zip(robot.action_features, action.tolist(), strict=True)))
    assert robot.world.distance_m(dict(point.truth["objects"])) < 1e-9


class _NoRecorder:
    """Stands in for a recorder where only the verdict is asked for."""

    def __init__(self) -> None:
        self._frames = 0

    def __len__(self) -> int:
        return self._frames

    def begin(self) -> None:
        """Forgets the episode before."""
        self._frames = 0

    def observed(self) -> None:
        """Nothing."""

    def add(self, *frame: Any) -> None:
        """Counts a frame."""
        self._frames += 1

    def save(self) -> None:
        """Nothing."""


class ExactTrials:
    """Trials of policies from exact starts on a connected lab.

    Args:
        robot: connected.
        checkpoints: by name.
    """

    def __init__(self, robot: Any, checkpoints: dict[str, str]):
        from lerobot_roborecover.robot.policies import load_context

        self._robot = robot
        self._contexts = {
            name: load_context(robot, path, fps=FPS, instruction=robot.instruction)
            for name, path in checkpoints.items()
        }

    def run(self, name: str, point: RobotPoint, offset_mm: np.ndarray) -> bool:
        """One trial; returns whether the task was done.

        Args:
            name: of the policy.
            point: where it starts.
            offset_mm: (2,) by which the puck is off.
        """
        from lerobot_roborecover.robot.console import Console
        from lerobot_roborecover.robot.lab.operator import SimulatedOperator
        from lerobot_roborecover.robot.rollout import RecordedRollout

        replay(self._robot, point)
        if offset_mm.any():
            self._robot.world.place(dict(point.truth["objects"]), offset_mm / 1000, 0.0)
        console = Console(SimulatedOperator(self._robot))
        console.show("running")
        recorder: Any = _NoRecorder()
        rollout = RecordedRollout(recorder, console, LIMIT_S, self._robot.instruction)
        rollout.setup(self._contexts[name])
        rollout.run(self._contexts[name])
        rollout.teardown(self._contexts[name])
        if rollout.end.problem:
            raise RuntimeError(rollout.end.problem)
        return bool(self._robot.world.succeeded())
