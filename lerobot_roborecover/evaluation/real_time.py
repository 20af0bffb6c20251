"""Real-time evaluation: charges inference time in control steps.

The paper's clock is frozen: the scene waits during an inference. With `--env.realtime=true` an inference of L
seconds costs ceil(L x control rate) steps of the trial. `--env.during_inference` selects what the robot does:

- `hold`: it repeats the last action; the new chunk follows.
- `chunk`: it continues the last chunk. The next inference starts before the chunk ends, as many steps as the
  last inference took. Actions of the new chunk whose time has passed are dropped.

Nothing is charged before a trial's first action, because there is no action to continue. An inference is an
answer that begins a new chunk: with n actions an inference, every n-th action of the policy. Nothing here
reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.errors import OptionError

DURING_INFERENCE = ("hold", "chunk")
_TINY = 1e-6
"""Tolerance in steps for rounding errors: 0.15 s at 20 steps a second must give three steps."""


@dataclass(frozen=True)
class RealTime:
    """How inferences are charged in a run."""

    during_inference: str
    """`hold` or `chunk`."""
    latency_s: float | None
    """Seconds of an inference; None takes what each has taken."""
    horizon: int
    """n: the policy's actions an inference."""

    def decisive(self) -> Mapping[str, object]:
        """Returns the settings for the trial row."""
        return {
            "realtime": self.during_inference,
            "latency_s": "measured" if self.latency_s is None else self.latency_s,
        }

    def steps(self, seconds: float, hz: float) -> int:
        """Control steps that an inference costs.

        Args:
            seconds: that it took.
            hz: control steps a second.
        """
        charged_s = seconds if self.latency_s is None else self.latency_s
        return max(math.ceil(charged_s * hz - _TINY), 0)


class LatencyModel:
    """One trial under a `RealTime`.

    Args:
        rule: of the run.
        hz: control steps a second.
    """

    def __init__(self, rule: RealTime, hz: float):
        self._rule, self._hz = rule, hz
        self._taken = 0
        """Actions that the policy has given."""
        self._last: np.ndarray | None = None
        """The last action sent to the simulator."""
        self._left: np.ndarray | None = None
        """(k, A) of the last chunk, not sent yet."""

    def sequence(self, actions: np.ndarray, seconds: float) -> np.ndarray:
        """(m, A) actions to execute, m at least 1: those of the time that has passed, then the policy's.

        Args:
            actions: (n, A), the policy's answer.
            seconds: that it took.

        Raises:
            OptionError: a chunk is to go on, and the policy gives single actions of it.
        """
        rule, inferred = self._rule, self._taken % self._rule.horizon == 0
        self._taken += len(actions)
        if not inferred:
            self._last = actions[-1]
            return actions
        if rule.during_inference == "chunk" and len(actions) < rule.horizon:
            raise OptionError(
                f"--env.during_inference=chunk: this policy gives the {rule.horizon} actions of an inference "
                "one by one, so that none is at hand during the next. Use --env.during_inference=hold"
            )
        charged = rule.steps(seconds, self._hz)
        waited, fresh = actions[:0], actions
        if self._last is not None:
            left = actions[:0] if self._left is None else self._left
            waited = left[:charged]
            held = waited[-1] if len(waited) else self._last
            waited = np.concatenate([waited, np.repeat(held[None], charged - len(waited), axis=0)])
            if rule.during_inference == "chunk":
                fresh = actions[min(charged, len(actions) - 1) :]
        keep = 0
        if rule.during_inference == "chunk":
            keep = min(charged, len(fresh) if len(waited) else len(fresh) - 1)
        sent = np.concatenate([waited, fresh[: len(fresh) - keep]])
        self._left, self._last = fresh[len(fresh) - keep :], sent[-1]
        return sent
