"""What a check of a machine or of a simulator found, for `roborecover doctor` and `check platform`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Status(StrEnum):
    """Outcome of a check; only a failure changes the exit status."""

    OK = "ok"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True)
class Check:
    """One line of a report."""

    name: str
    """What was looked at."""
    status: Status
    detail: str
    """What was found."""
    remedy: str = ""
    """What to do about it; empty when all is well."""

    @property
    def failed(self) -> bool:
        """Whether this alone makes the report a failure."""
        return self.status is Status.FAILURE
