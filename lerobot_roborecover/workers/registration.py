"""Registers the Gymnasium ids; the package does so on import, as Gymnasium has no other way to find them."""

from __future__ import annotations

import gymnasium as gym

from lerobot_roborecover.platforms import platform_names


def register() -> None:
    """Registers `roborecover/<Platform>-v0` of every platform; none is imported."""
    for name in platform_names():
        gym.register(
            id=f"roborecover/{name.capitalize()}-v0",
            entry_point="lerobot_roborecover.workers.recovery_env:make_env",
            kwargs={"platform": name},
        )
