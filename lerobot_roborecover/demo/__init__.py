"""`roborecover demo`: the shipped policy on the shipped Meta-World scenarios, in pictures."""

from __future__ import annotations

from lerobot_roborecover.errors import RoboRecoverError


class DemoError(RoboRecoverError, RuntimeError):
    """The demo cannot run or go on; the message says why and what to do."""
