"""What monitors refuse."""

from __future__ import annotations

from lerobot_roborecover.errors import OptionError


class MonitorError(OptionError):
    """A monitor cannot be built, loaded or asked; the message says what, the value and the remedy."""
