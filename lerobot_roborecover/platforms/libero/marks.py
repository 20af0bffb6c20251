"""Where a LIBERO task wants its objects: a mark for each goal that is about a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco

from lerobot_roborecover.platforms.libero.goals import PLACE_KINDS
from lerobot_roborecover.platforms.simulator import GOAL_OF
from lerobot_roborecover.scenario import Pose

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import LiberoEnv

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class PlaceMark:
    """One goal's mark."""

    name: str
    """Of the object's body, with `GOAL_OF`."""
    site: int | None
    """Where it belongs: this site's place,"""
    body: int
    """or else this body's."""

    def pose(self, data: mujoco.MjData) -> Pose:
        """Where the place is now, without a direction of its own."""
        x, y, z = map(float, data.xpos[self.body] if self.site is None else data.site_xpos[self.site])
        return Pose((x, y, z), _UPRIGHT)


def place_marks(env: LiberoEnv, model: mujoco.MjModel) -> tuple[PlaceMark, ...]:
    """The marks of a task: of every `On` and `In` of its goal, in LIBERO's order.

    Args:
        env: LIBERO's environment of the task.
        model: as compiled last.
    """
    found = []
    for kind, *about in env.parsed_problem["goal_state"]:
        if kind not in PLACE_KINDS:
            continue
        item, place = about
        name = model.body(env.obj_body_id[item]).name + GOAL_OF
        if place in env.object_sites_dict:
            found.append(PlaceMark(name, env.sim.model.site_name2id(place), -1))
        else:
            found.append(PlaceMark(name, None, env.obj_body_id[place]))
    return tuple(found)
