"""Skips rendering in PushT and Aloha, which otherwise render in every step.

Inside the context manager `Unseen` nothing is rendered. `complete` renders the policy's images of the current
state.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_roborecover.platforms.lerobot.state import physics_of
from lerobot_roborecover.platforms.simulator import Observation


class Unseen:
    """Base class for unknown environments: skips no rendering, keeps every step's observation unchanged."""

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def before_reset(self) -> None:
        """Forgets what a reset of the environment's own would keep."""

    def complete(self, seen: Observation) -> Observation:
        """The observation with its pictures.

        Args:
            seen: of the last step.
        """
        return _copied(seen)


class UnseenPlane(Unseen):
    """gym_pusht's `PushTEnv`: `_render` draws.

    Args:
        inner: the environment.
    """

    def __init__(self, inner: Any):
        self._inner = inner
        self._drawn = "pixels" in inner.obs_type
        self._blank = np.zeros((inner.observation_height, inner.observation_width, 3), np.uint8)

    def __enter__(self) -> None:
        if self._drawn:
            self._inner._render = lambda visualize=False: self._blank

    def __exit__(self, *_: object) -> None:
        if self._drawn:
            del self._inner._render

    def before_reset(self) -> None:
        """The cross that shows the last action would stay in the picture of a first state."""
        self._inner._last_action = None

    def complete(self, seen: Observation) -> Observation:
        return dict(self._inner.get_obs()) if self._drawn else _copied(seen)


class UnseenPhysics(Unseen):
    """gym_aloha's `AlohaEnv`: dm_control's `physics.render` draws three cameras a step, of which one is seen.

    Args:
        inner: the environment.
        physics: dm_control's.
    """

    def __init__(self, inner: Any, physics: Any):
        self._inner, self._physics = inner, physics

    def __enter__(self) -> None:
        self._physics.render = _blank

    def __exit__(self, *_: object) -> None:
        del self._physics.render

    def complete(self, seen: Observation) -> Observation:
        """Draws the one camera, as large as the environment's task does."""
        draw, physics = self._physics.render, self._physics

        def one(height: int, width: int, camera_id: str, **more: Any) -> np.ndarray:
            return (draw if camera_id == "top" else _blank)(
                height=height, width=width, camera_id=camera_id, **more
            )

        physics.render = one
        try:
            return self._inner._format_raw_obs(self._inner._env.task.get_observation(physics))
        finally:
            del physics.render


def unseen(env: gym.Env) -> Unseen:
    """What to leave out of an environment's steps; nothing, where a wrapper changes its observations."""
    layer = env
    while isinstance(layer, gym.Wrapper):
        if isinstance(layer, (gym.ObservationWrapper, gym.wrappers.TransformObservation)):
            return Unseen()
        layer = layer.env
    inner = env.unwrapped
    kind = f"{type(inner).__module__}.{type(inner).__name__}"
    if kind == "gym_pusht.envs.pusht.PushTEnv":
        return UnseenPlane(inner)
    physics = physics_of(env) if kind == "gym_aloha.env.AlohaEnv" else None
    return Unseen() if physics is None else UnseenPhysics(inner, physics)


def _blank(height: int = 480, width: int = 640, camera_id: Any = None, **_: Any) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def _copied(seen: Any) -> Any:
    if isinstance(seen, dict):
        return {key: _copied(value) for key, value in seen.items()}
    return seen.copy() if isinstance(seen, np.ndarray) else seen
