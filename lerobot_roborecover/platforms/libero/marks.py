"""Where a LIBERO task wants its objects and drawers: marks for each goal that is about a place."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from lerobot_roborecover.platforms.libero.catalog import PLACE_KINDS
from lerobot_roborecover.platforms.libero.joints import FixtureJoint
from lerobot_roborecover.platforms.simulator import GOAL_OF, HANDLE
from lerobot_roborecover.scenario import Pose

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import LiberoEnv

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class PlaceMarks:
    """The marks of a task: of every `On` and `In` of its goal, in its order, and of every drawer that is to
    be opened or closed, whose handle is marked, too. What turns has none.

    Args:
        env: LIBERO's environment of the task.
        model: as compiled last.
        data: the simulation, read at every call.
    """

    def __init__(self, env: LiberoEnv, model: mujoco.MjModel, data: mujoco.MjData):
        self._env, self._model, self._data = env, model, data
        self._places: dict[str, Callable[[], np.ndarray]] = {}
        for kind, *about in env.parsed_problem["goal_state"]:
            if kind in PLACE_KINDS:
                self._add_object(*about)
            elif kind in ("open", "close"):
                self._add_drawer(about[0], kind == "open")

    def poses(self) -> dict[str, Pose]:
        """The marks now, without a direction of their own."""
        return {name: Pose(_floats(place()), _UPRIGHT) for name, place in self._places.items()}

    def _add_object(self, item: str, place: str) -> None:
        env, data = self._env, self._data
        name = self._model.body(env.obj_body_id[item]).name + GOAL_OF
        if place in env.object_sites_dict:
            site = env.sim.model.site_name2id(place)
            self._places[name] = lambda: data.site_xpos[site]
        else:
            body = env.obj_body_id[place]
            self._places[name] = lambda: data.xpos[body]

    def _add_drawer(self, region: str, open_it: bool) -> None:
        site = self._env.object_sites_dict.get(region)
        if site is None or not site.joints:
            return
        joint = FixtureJoint(self._model, self._data, site.joints[0])
        if joint.hinged:
            return
        name = self._model.body(joint.body).name
        self._places[name + HANDLE] = lambda: joint.handle_m
        self._places[name + GOAL_OF] = lambda: joint.handle_m + joint.way_m(open_it)


def _floats(place: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = map(float, place)
    return x, y, z
