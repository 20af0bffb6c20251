"""Every env type of LeRobot's as a platform: PushT, Aloha, third parties', and environments on the Hub."""

from lerobot_roborecover.platforms.lerobot.platform import FAMILY as PLATFORM
from lerobot_roborecover.platforms.lerobot.platform import member

__all__ = ["PLATFORM", "member"]
