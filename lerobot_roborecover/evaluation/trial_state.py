"""Where a trial is, and what a simulator's failure makes of it."""

from __future__ import annotations

from enum import StrEnum

from lerobot_roborecover.scenario import Outcome

FAILURES = {
    "raised": Outcome.SIM_ERROR,
    "died": Outcome.SIM_ERROR,
    "hung": Outcome.TIMEOUT,
    "lost": Outcome.SIM_ERROR,
}
"""Outcome of a trial by the kind of its slot's failure; a `lost` trial is first run again elsewhere."""


class TrialState(StrEnum):
    NEW = "new"
    """No request has been sent yet."""
    HANDING_OFF = "handing_off"
    """A simulator rebuilds its start."""
    WAITING = "waiting"
    """It has an observation that the policy has not received yet."""
    ASKED = "asked"
    """The policy infers."""
    ACTING = "acting"
    """A simulator executes actions."""
    ROLLING_BACK = "rolling_back"
    """A simulator is rolled back to an earlier state."""
    OVER = "over"
    """It has an outcome, or was skipped."""


IN_SIMULATOR = (TrialState.HANDING_OFF, TrialState.ACTING, TrialState.ROLLING_BACK)
"""States that a simulator's reply ends."""
