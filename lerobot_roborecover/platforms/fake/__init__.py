"""A point mass with a puck, for tests of everything above a simulator."""

from lerobot_roborecover.platforms.fake.platform import PLATFORM

__all__ = ["PLATFORM"]
