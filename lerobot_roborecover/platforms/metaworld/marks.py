"""Points of a Meta-World task that a reviewer of a rollout needs: the handled object and its goal.

A body's centre of mass shows neither: the basketball's lies 0.6 m from the ball, and a goal is not a body.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from lerobot_roborecover.platforms.simulator import GOAL, HANDLE
from lerobot_roborecover.scenario import Pose

if TYPE_CHECKING:
    from metaworld.sawyer_xyz_env import SawyerXYZEnv

FINAL_OFFSET_M: Mapping[str, tuple[float, float, float]] = {
    "assembly-v3": (0.13, 0.0, 0.0),
    "disassemble-v3": (0.11, 0.0, 0.0),
    "hammer-v3": (-0.16, -0.09, 0.0),
    "peg-insert-side-v3": (0.19, 0.0, 0.0),
    "stick-push-v3": (-0.22, 0.02, -0.04),
}
"""Where the handled point is relative to the observation's goal once the scripted policy has solved the task
(metaworld 3.0.0, seeds 3 to 5); elsewhere it is within some 8 cm of it."""

_OBJECT, _GOAL = slice(4, 7), slice(36, 39)
"""First object and goal in the 39 numbers."""
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def handled_body(env: SawyerXYZEnv, parts: Mapping[str, Iterable[int]], raw: np.ndarray) -> str | None:
    """The body that Meta-World's observation is about: the one with a geom nearest to the observed point.

    Args:
        env: a `SawyerXYZEnv` right after its reset.
        parts: body ids by tracked body.
        raw: (39,) its observation.
    """
    distances = {}
    for name, bodies in parts.items():
        geoms = np.flatnonzero(np.isin(env.model.geom_bodyid, list(bodies)))
        if len(geoms):
            distances[name] = np.linalg.norm(env.data.geom_xpos[geoms] - raw[_OBJECT], axis=1).min()
    return min(distances, key=distances.__getitem__, default=None)


def marks(task_name: str, handled: str | None, raw: np.ndarray, behind: np.ndarray) -> dict[str, Pose]:
    """The marks of a task at a moment; without a direction of their own.

    Args:
        task_name: decides where the handled point ends.
        handled: see `handled_body`; without it there are no marks.
        raw: (39,) observation with the goal shown.
        behind: (3,) metres by which it has the handled point too short: of a first state.
    """
    if handled is None:
        return {}
    goal = raw[_GOAL] + FINAL_OFFSET_M.get(task_name, (0.0, 0.0, 0.0))
    return {
        f"{handled}{HANDLE}": Pose(tuple(raw[_OBJECT] + behind), _UPRIGHT),
        GOAL: Pose(tuple(goal), _UPRIGHT),
    }
