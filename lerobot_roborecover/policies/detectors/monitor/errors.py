"""Error of detectors and monitors."""

from __future__ import annotations

from lerobot_roborecover.errors import OptionError


class MonitorError(OptionError):
    """A monitor or detector cannot be built, loaded or asked; the message names the value and the remedy."""
