"""Brings a robot's joints back along a recorded approach: slowly, within limits, stopped on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.robot.clock import clock_of
from lerobot_roborecover.robot.connection import LIMIT_MARGIN, RobotError, asking, limits_of, positions
from lerobot_roborecover.robot.points import RobotPoint

_RATE_HZ = 20.0
_NAMED_JOINTS = 3


class StoppedError(RobotError):
    """A person has stopped the robot."""


@dataclass(frozen=True)
class MotionConfig:
    """How fast and how far joints may move, in the robot's units (degrees on an SO-101)."""

    speed: float = 15.0
    """Speed of the fastest joint, units a second."""
    max_detour: float = 10.0
    """Farthest that a joint may be from the recorded approach before a person is asked whether the straight
    way there is free."""
    tolerance: float = 2.0
    """How near each joint has to come to the recovery point."""
    max_lag: float = 25.0
    """A joint that is farther than this from its target is blocked: the robot stops."""
    settle_s: float = 3.0
    """How long joints may take to come near, at the end."""


def move_to(
    robot: Any,
    point: RobotPoint,
    config: MotionConfig,
    *,
    stopped: Callable[[], bool],
    confirm: Callable[[str], bool],
    given: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, float]:
    """Moves the joints to a recovery point along its approach.

    Args:
        robot: connected.
        point: checked by `check_point`.
        config: speeds and limits.
        stopped: asked before each small step; True leaves the robot where it is.
        confirm: asks a person a yes-or-no question.
        given: limits from the user.

    Returns:
        Measured minus recorded position by joint.

    Raises:
        StoppedError: a person stopped it, or did not confirm.
        RobotError: a joint is blocked, or does not come near.
    """
    names = list(point.joints)
    bounds = np.array([limits_of(robot, given)[n] for n in names])
    here = _measure(robot, names)
    path = _within(point.approach, bounds)
    gaps = np.abs(path - here).max(1)
    start = int(gaps.argmin())
    if gaps[start] > config.max_detour:
        start = 0
        if not confirm(
            "The arm is off the recorded approach and would go straight to where that begins: "
            f"{_moves(names, path[0] - here, point.units)}. Is that way free?"
        ):
            raise StoppedError("the straight way to the approach was not confirmed; move the arm by hand")
    for waypoint in path[start:]:
        here = _follow(robot, names, here, waypoint, config, stopped)
    clock = clock_of(robot)
    until = clock.now() + config.settle_s
    goal = path[-1]
    while True:
        error = _measure(robot, names) - goal
        if np.abs(error).max() <= config.tolerance or clock.now() > until:
            break
        _send(robot, names, goal, stopped)
        clock.sleep(1 / _RATE_HZ)
    return dict(zip(names, error.tolist(), strict=True))


def _moves(names: list[str], gap: np.ndarray, units: Mapping[str, str]) -> str:
    """The largest moves of a straight way, e.g. `x by +59 mm, y by -12 mm`."""
    largest = sorted(range(len(names)), key=lambda j: -abs(gap[j]))[:_NAMED_JOINTS]
    return ", ".join(
        f"{names[j].removesuffix('.pos')} by {gap[j]:+.0f} {units.get(names[j]) or 'units'}" for j in largest
    )


def _within(path: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """(T, J) targets, inside the limits; what is a measurement's noise outside is moved to them."""
    inside = np.clip(path, bounds[:, 0], bounds[:, 1])
    if (np.abs(path - inside) > LIMIT_MARGIN * (bounds[:, 1] - bounds[:, 0])).any():
        raise RobotError("the recorded approach leaves the calibrated limits; the robot was not moved")
    return inside


def _follow(
    robot: Any,
    names: list[str],
    start: np.ndarray,
    goal: np.ndarray,
    config: MotionConfig,
    stopped: Callable[[], bool],
) -> np.ndarray:
    """Takes small steps from the last target to the next one; returns it."""
    steps = max(int(np.ceil(np.abs(goal - start).max() / config.speed * _RATE_HZ)), 1)
    clock = clock_of(robot)
    for step in range(1, steps + 1):
        target = start + (goal - start) * step / steps
        _send(robot, names, target, stopped)
        clock.sleep(1 / _RATE_HZ)
        lag = np.abs(_measure(robot, names) - target)
        if lag.max() > config.max_lag:
            worst = int(lag.argmax())
            raise RobotError(
                f"joint {names[worst]} is {lag[worst]:.0f} from its target, at most {config.max_lag:g}: it "
                "is blocked, or its torque is off. The robot was stopped; look at it before going on"
            )
    return goal


def _send(robot: Any, names: list[str], target: np.ndarray, stopped: Callable[[], bool]) -> None:
    if stopped():
        raise StoppedError("stopped by a person; the arm stays where it is")
    with asking(robot):
        observation = robot.get_observation() if set(names) != set(robot.action_features) else {}
        still = {n: float(observation[n]) for n in robot.action_features if n in observation}
        robot.send_action({**still, **dict(zip(names, target.tolist(), strict=True))})


def _measure(robot: Any, names: list[str]) -> np.ndarray:
    with asking(robot):
        found = positions(robot, robot.get_observation())
    return np.array([found[n] for n in names])
