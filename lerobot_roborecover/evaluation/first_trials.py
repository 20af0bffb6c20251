"""Stops a run whose first trials all fail alike: such a run measures its configuration, not the policy."""

from __future__ import annotations

import re

from lerobot_roborecover.errors import RoboRecoverError
from lerobot_roborecover.evaluation.trial import Trial
from lerobot_roborecover.logs.fields import CALLABLE
from lerobot_roborecover.policies.runner import Replica
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.utils.text import pluralize

FIRST_TRIALS = 3
"""Trials that must fail alike; all of a shorter run."""
_CHECK = (
    "'roborecover check policy' with the same options says what policy and environment do not agree on; "
    "correct that"
)
_CALLABLE = 'docs/api.md, "Any policy", says what a callable is given and what it returns; correct it'


class PolicyFailedError(RoboRecoverError, RuntimeError):
    """The first trials of a run ended in the same policy error, before any action."""

    exit_status = 1


class FirstTrials:
    """Holds the rows of the first trials back while all of them fail alike.

    Only a policy error at step 0 counts: a policy that has acted is a policy that can be measured. The rows
    of a run that is stopped are not written, so that a corrected command runs their trials.

    Args:
        trials: of the run.
        policy_type: of the policy, `logs.fields.CALLABLE` among others.
        remedy: what to do, where it is known.
    """

    def __init__(self, trials: int, policy_type: str | None = None, remedy: str = ""):
        self._limit = min(FIRST_TRIALS, trials)
        self._remedy = remedy or (_CALLABLE if policy_type == CALLABLE else _CHECK)
        self._held: list[tuple[Trial, Replica]] = []

    def hold(self, trial: Trial, replica: Replica) -> bool:
        """Returns whether a finished trial's row is to wait.

        Raises:
            PolicyFailedError: enough trials have failed alike.
        """
        failed = trial.verdict() is Outcome.POLICY_ERROR and trial.steps == 0
        if not failed or (self._held and _kind(self._held[0][0]) != _kind(trial)):
            return False
        self._held.append((trial, replica))
        if len(self._held) < self._limit:
            return True
        count = len(self._held)
        first = "the only trial" if count == 1 else f"the first {pluralize(count, 'trial')}"
        reason = " ".join(trial.reason.removeprefix("at step 0: ").split()).rstrip(".")
        raise PolicyFailedError(
            f"{first} ended in the same policy error before any action, and the run was stopped: {reason}. "
            f"No row was written. {self._remedy[0].upper()}{self._remedy[1:]}, then run it again"
        )

    def release(self) -> list[tuple[Trial, Replica]]:
        """Returns the trials that were held back."""
        held, self._held = self._held, []
        return held


def _kind(trial: Trial) -> str:
    """The reason without its numbers, which may differ between scenarios."""
    return re.sub(r"\d+(\.\d+)?(e[+-]?\d+)?", "#", trial.reason)
