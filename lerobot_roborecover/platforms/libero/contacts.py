"""robosuite's `check_contact` on ids in place of names.

LIBERO's predicates and robosuite's grasp ask which geoms touch. robosuite looks up the names of both geoms of
every contact and searches lists for them, which costs more than all other parts of a predicate together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from lerobot_roborecover.platforms.libero.robosuite_types import LiberoEnv, MujocoModel, Sim

    type Geoms = str | list[str] | tuple[str, ...] | MujocoModel

_GEOM = mujoco.mjtObj.mjOBJ_GEOM


class ContactCheck:
    """In place of `env.check_contact` (robosuite/environments/base.py), with its arguments and answers.

    Args:
        env: whose contacts.
    """

    def __init__(self, env: LiberoEnv):
        self._env = env
        self._sim: Sim | None = None
        self._masks: dict[object, np.ndarray] = {}

    def __call__(self, geoms_1: Geoms, geoms_2: Geoms | None = None) -> bool:
        """Whether a geom of the first group touches one of the second, or any at all.

        Args:
            geoms_1: a geom's name, names, or a robosuite model: then its contact geoms.
            geoms_2: the same; None for any other geom.
        """
        pairs = self._env.sim.data._data.contact.geom
        first = self._mask(geoms_1)[pairs]
        if geoms_2 is None:
            return bool(first.any())
        second = self._mask(geoms_2)[pairs]
        return bool((first & second[:, ::-1]).any())

    def _mask(self, geoms: Geoms) -> np.ndarray:
        """(ngeom,) bool; names that the model lacks touch nothing."""
        sim = self._env.sim
        if self._sim is not sim:  # a hard reset made a new one, with new objects
            self._sim, self._masks = sim, {}
        key = (geoms,) if isinstance(geoms, str) else tuple(geoms) if isinstance(geoms, list) else geoms
        if key not in self._masks:
            names = set(key if isinstance(key, tuple) else key.contact_geoms)
            known = [mujoco.mj_id2name(sim.model._model, _GEOM, i) for i in range(sim.model._model.ngeom)]
            self._masks[key] = np.array([name in names for name in known])
        return self._masks[key]
