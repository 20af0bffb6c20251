"""The robot of a run: what it is, what its joints may do, and whether a recovery point is one of its own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.robot.points import RobotPoint

LIMIT_MARGIN = 0.01
"""Share of a joint's range by which a recorded position may be outside: at the end of its range, noise is."""


class RobotError(RoboRecoverError, RuntimeError):
    """The robot cannot do what was asked; the message says what, why and the remedy."""


class RobotLostError(RobotError):
    """The robot, or one of its cameras, does not answer any more."""


@contextmanager
def connected(config: Any) -> Generator[Any]:
    """Connects a LeRobot robot for a block and disconnects it afterwards.

    Args:
        config: a LeRobot `RobotConfig`.

    Raises:
        RobotLostError: it cannot be connected.
        RobotError: its configuration or its packages do not make a robot.
    """
    from lerobot.robots import make_robot_from_config

    try:
        robot = make_robot_from_config(config)
    except (ImportError, ValueError, OSError) as err:
        cause = err.__cause__ or err  # LeRobot names the whole configuration, and then the reason
        if isinstance(cause, RoboRecoverError):
            raise cause from None
        raise RobotError(f"--robot.type: {_line(cause)}") from err
    try:
        robot.connect()
    except (ConnectionError, OSError, RuntimeError, ValueError) as err:
        raise RobotLostError(
            f"robot {robot.name} cannot be connected: {_line(err)}. Check its power, its cable and "
            "--robot.port"
        ) from err
    try:
        yield robot
    finally:
        with suppress(Exception):  # a robot that was unplugged cannot be disconnected
            robot.disconnect()


@contextmanager
def asking(robot: Any) -> Generator[None]:
    """Turns what a driver raises in the block into one line.

    Raises:
        RobotLostError: the robot or a camera does not answer.
    """
    try:
        yield
    except (ConnectionError, OSError, TimeoutError, RuntimeError) as err:
        if isinstance(err, RoboRecoverError):
            raise
        raise RobotLostError(
            f"robot {robot.name} does not answer: {_line(err)}. Check its cables and power, then start the "
            "same command again: it goes on with the trial that was cut short"
        ) from err


def _line(err: BaseException) -> str:
    return " ".join(str(err).split())[:200] or type(err).__name__


def calibration_sha256(robot: Any) -> str:
    """Hash of a robot's calibration; empty where it has none."""
    calibration = getattr(robot, "calibration", None) or {}
    if not calibration:
        return ""
    plain = {str(n): asdict(c) if is_dataclass(c) else c for n, c in calibration.items()}
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def joint_names(robot: Any) -> tuple[str, ...]:
    """Features that are position targets as well as measurements, in the order of the actions."""
    return tuple(n for n in robot.action_features if n.endswith(".pos") and n in robot.observation_features)


def camera_names(robot: Any) -> tuple[str, ...]:
    """Features that are colour pictures."""
    return tuple(
        n for n, f in robot.observation_features.items() if isinstance(f, tuple) and len(f) == 3 and f[2] == 3
    )


def joint_units(robot: Any) -> dict[str, str]:
    """Unit by joint, as far as the robot or its motors say one."""
    known = getattr(robot, "joint_units", None)
    if known is not None:
        return dict(known)
    words = {"degrees": "deg", "range_0_100": "percent", "range_m100_100": "percent"}
    motors = getattr(getattr(robot, "bus", None), "motors", {})
    units = {f"{n}.pos": words.get(str(m.norm_mode.value), "") for n, m in motors.items()}
    return {name: units.get(name, "") for name in joint_names(robot)}


def joint_limits(robot: Any) -> dict[str, tuple[float, float]]:
    """Calibrated range by joint; a joint of which none is known is left out.

    A Feetech or Dynamixel joint in degrees counts from the middle of its calibrated range.
    """
    known = getattr(robot, "joint_limits", None)
    if known is not None:
        return dict(known)
    bus: Any = getattr(robot, "bus", None)
    found: dict[str, tuple[float, float]] = {}
    for name, motor in getattr(bus, "motors", {}).items():
        mode, calibration = str(motor.norm_mode.value), (robot.calibration or {}).get(name)
        if mode == "range_0_100":
            found[f"{name}.pos"] = (0.0, 100.0)
        elif mode == "range_m100_100":
            found[f"{name}.pos"] = (-100.0, 100.0)
        elif mode == "degrees" and calibration is not None:
            resolution = bus.model_resolution_table[motor.model] - 1
            half = 180.0 * (calibration.range_max - calibration.range_min) / resolution
            found[f"{name}.pos"] = (-half, half)
    return found


def check_point(
    point: RobotPoint, robot: Any, given: Mapping[str, tuple[float, float]] | None = None
) -> None:
    """Refuses a recovery point that this robot cannot be put back to.

    Args:
        point: what to go to.
        robot: connected.
        given: limits that the user gave, by joint; they narrow the calibrated ones.

    Raises:
        RobotError: another robot or calibration, other joints or cameras, outside the limits, not at rest.
    """
    if point.robot_type != robot.name:
        raise RobotError(
            f"point {point.id} is of robot {point.robot_type!r}, this one is {robot.name!r}: joint numbers "
            "mean other places. Take points of this robot"
        )
    own = calibration_sha256(robot)
    if point.calibration_sha256 != own:
        raise RobotError(
            f"point {point.id} was recorded with calibration {point.calibration_sha256[:12] or 'unknown'}, "
            f"this robot has {own[:12] or 'none'}: the same numbers are other places. Load that calibration "
            "(--robot.id, --robot.calibration_dir), or capture the points again"
        )
    names = joint_names(robot)
    if set(point.joints) != set(names):
        odd = sorted(set(point.joints) ^ set(names))[0]
        raise RobotError(f"point {point.id}: joint {odd!r} is not in both the point and the robot")
    missing = [c for c in point.cameras if c not in camera_names(robot)]
    if missing:
        raise RobotError(
            f"point {point.id} was seen by camera {missing[0]!r}; the robot has "
            f"{', '.join(camera_names(robot)) or 'none'}. Add it to --robot.cameras under that name"
        )
    if not point.quasi_static:
        raise RobotError(
            f"point {point.id} is not quasi-static: something was falling, sliding or held by friction "
            "alone, and a hand cannot put that back. Leave it out"
        )
    limits = limits_of(robot, given)
    columns = list(point.joints)
    for name, (low, high) in limits.items():
        values = point.approach[:, columns.index(name)]
        worst = float(values[np.argmax(np.abs(values - (low + high) / 2))])
        margin = LIMIT_MARGIN * (high - low)
        if not low - margin <= worst <= high + margin:
            raise RobotError(
                f"point {point.id}: joint {name} goes to {worst:.1f}, outside its calibrated {low:.1f} to "
                f"{high:.1f}. The point is not run; calibrate the robot again or leave the point out"
            )


def limits_of(
    robot: Any, given: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, tuple[float, float]]:
    """Limits of every joint.

    Args:
        robot: connected.
        given: by joint, from the user.

    Raises:
        RobotError: a joint has none.
    """
    known, found = joint_limits(robot), {}
    for name in joint_names(robot):
        ranges = [r for r in (known.get(name), (given or {}).get(name)) if r is not None]
        if not ranges:
            raise RobotError(
                f"joint {name} has no calibrated limits, so that nothing would stop a wrong target. "
                f"Calibrate the robot, or give them: --limits='{{{name}: [LOW, HIGH]}}'"
            )
        found[name] = (max(r[0] for r in ranges), min(r[1] for r in ranges))
    return found


def positions(robot: Any, observation: Mapping[str, Any]) -> dict[str, float]:
    """Joint positions of an observation."""
    return {name: float(observation[name]) for name in joint_names(robot)}
