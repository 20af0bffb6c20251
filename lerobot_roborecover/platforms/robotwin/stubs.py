"""Stands in for packages that RoboTwin imports and joint control does not need.

- `mplib` plans motions; of it, joint control uses only `TOPP`, the time-optimal parameterisation of the
  straight line between two joint positions. mplib has no build for numpy 2 (it crashes the process), so its
  few lines on top of toppra are here. Their trajectories differ by less than 0.04 mm.
- `curobo` plans collision-free motions on a GPU, for end-effector actions and for the scripted expert
  `play_once`. Where it is installed the real one is used; where not, its planner can be made and asked to
  move a gripper, which is arithmetic, and nothing else.
- `open3d` writes point clouds, which are not used here. The real one is used where it is installed.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np

from lerobot_roborecover.platforms.simulator import SimulatorError

_CUROBO = (
    "curobo",
    "curobo.types",
    "curobo.types.math",
    "curobo.types.robot",
    "curobo.util",
    "curobo.wrap",
    "curobo.wrap.reacher",
    "curobo.wrap.reacher.motion_gen",
)


def has_curobo() -> bool:
    """Whether the real curobo is installed."""
    module = sys.modules.get("curobo")
    if module is not None:
        return not isinstance(module, _Stub)
    return importlib.util.find_spec("curobo") is not None


def install() -> None:
    """Puts the stand-ins where RoboTwin's imports find them; real packages are left alone, but for mplib.

    Raises:
        SimulatorError: a curobo is there that cannot be imported. RoboTwin would go on, and fail later over a
            planner that has no name.
    """
    if not isinstance(sys.modules.get("mplib"), _Stub):
        _register("mplib", Planner=Planner)
        _register("mplib.planner", Planner=Planner)
        _register("mplib.sapien_utils", SapienPlanner=Planner, SapienPlanningWorld=_PlanningWorld)
    if not has_curobo() and "curobo" not in sys.modules:
        refuse = _refusal("curobo", "planning a motion")
        has: dict[str, dict[str, Any]] = {
            "curobo.types.math": {"Pose": refuse},
            "curobo.types.robot": {"JointState": refuse},
            "curobo.util": {"logger": _Logger},
            "curobo.wrap.reacher.motion_gen": {
                "MotionGen": _MotionGen,
                "MotionGenConfig": _MotionGenConfig,
                "MotionGenPlanConfig": refuse,
                "PoseCostMetric": refuse,
            },
        }
        for name in _CUROBO:
            _register(name, **has.get(name, {}))
    elif has_curobo():
        try:
            importlib.import_module(_CUROBO[-1])
        except Exception as err:
            raise SimulatorError(
                f"curobo is installed but cannot be imported ({err}). Repair it for this Python, torch and "
                "CUDA, or take it away (pip uninstall nvidia_curobo): joint actions do not need it"
            ) from err
    if "open3d" not in sys.modules and importlib.util.find_spec("open3d") is None:
        _register("open3d")


class Planner:
    """mplib's planner, as far as joint control needs it.

    Args:
        planning_world: what `SapienPlanningWorld` returned, for the number of joints.
        move_group: link at the arm's end.
    """

    def __init__(self, planning_world: Any = None, move_group: str = "", **_: Any):
        self.move_group = move_group

    def TOPP(  # noqa: N802 - mplib's name
        self, path: np.ndarray, step: float = 0.1, verbose: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Time-optimal trajectory along a path, within 1 rad/s and 1 rad/s² (mplib's own limits).

        Args:
            path: (N, J) joint positions to pass, radians.
            step: time between samples, seconds.
            verbose: ignored, as by mplib.

        Returns:
            Times (T,), positions, velocities and accelerations (T, J), and the duration in seconds.

        Raises:
            RuntimeError: no such trajectory, e.g. start and end coincide. RoboTwin then leaves the arm alone.
        """
        path = np.ascontiguousarray(path, dtype=np.float64)
        found = _time_optimal(path.tobytes(), path.shape, step)
        if found is None:
            raise RuntimeError("Fail to parameterize path")
        *samples, duration = found
        times, positions, velocities, accelerations = (array.copy() for array in samples)
        return times, positions, velocities, accelerations, duration

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _refusal("mplib", name)


@functools.lru_cache(maxsize=1024)
def _time_optimal(
    path: bytes, shape: tuple[int, ...], step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float] | None:
    """What `Planner.TOPP` gives, or None where there is no such trajectory.

    Kept, because it takes most of a step's time and the same paths come again: of the arm that stays where it
    is in every action, of the other one in every replay of a prefix. Some 25 KB each.
    """
    import toppra
    from toppra import algorithm, constraint, parametrizer

    joints = np.frombuffer(path).reshape(shape)
    spline = toppra.SplineInterpolator(np.linspace(0, 1, shape[0]), joints)
    limits = [
        constraint.JointVelocityConstraint(np.ones(shape[1])),
        constraint.JointAccelerationConstraint(np.ones(shape[1])),
    ]
    trajectory = algorithm.TOPPRA(limits, spline, parametrizer="ParametrizeConstAccel").compute_trajectory()
    if not isinstance(trajectory, parametrizer.ParametrizeConstAccel):
        return None
    times = np.linspace(0, trajectory.duration, int(trajectory.duration / step))
    return times, trajectory(times), trajectory(times, 1), trajectory(times, 2), trajectory.duration


class _PlanningWorld:
    def __init__(self, *_: Any, **__: Any):
        pass


class _MotionGenConfig:
    @staticmethod
    def load_from_robot_config(*_: Any, **__: Any) -> None:
        return None


class _MotionGen:
    def __init__(self, *_: Any):
        pass

    def warmup(self, **_: Any) -> None:
        pass

    def reset(self, **_: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return _refusal("curobo", name)


class _Logger:
    @staticmethod
    def setup_logger(**_: Any) -> None:
        pass


class _Stub(ModuleType):
    """A module that refuses what it does not have, by name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _refusal(self.__name__.split(".")[0], name)


class _Refusal:
    def __init__(self, package: str, what: str):
        self._message = (
            f"RoboTwin asked {package} for {what}, but {package} is not usable here and only joint control "
            "works without it. Use joint actions (width 14), or install what RoboTwin's own installation "
            "guide names (curobo needs an NVIDIA GPU)"
        )

    def __call__(self, *_: Any, **__: Any) -> Any:
        raise SimulatorError(self._message)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self


def _refusal(package: str, what: str) -> _Refusal:
    return _Refusal(package, what)


def _register(name: str, **attributes: Any) -> None:
    module = _Stub(name)
    module.__path__ = []
    for key, value in attributes.items():
        setattr(module, key, value)
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], child, module)


refuse_expert = _refusal("curobo", "its scripted expert, play_once")
"""In place of `play_once` where there is no curobo."""
