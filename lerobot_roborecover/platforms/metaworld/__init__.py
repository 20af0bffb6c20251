"""Meta-World on MuJoCo: fifty Sawyer tasks from PyPI alone."""

from lerobot_roborecover.platforms.metaworld.platform import PLATFORM

__all__ = ["PLATFORM"]
