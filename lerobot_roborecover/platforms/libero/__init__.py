"""LIBERO on MuJoCo: hf-libero's own environments, tasks and init states."""

from lerobot_roborecover.platforms.libero.platform import PLATFORM

__all__ = ["PLATFORM"]
