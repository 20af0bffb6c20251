"""Decides how long trials that wait for a policy wait for others to join their batch.

A policy can be shared in two good ways. In halves: the trials that are ready form a batch while the others
step, so two halves take turns. Together: all trials form one batch.

Let n be the number of slots, l + e b the seconds of an inference for b observations, and s the seconds of
simulation between an answer and the next observation. A round of all slots then takes
max(s + l + e n / 2, 2 l + e n) in halves and s + l + e n together. So one batch is faster where s < l, and
halves are faster where s > l, for every e.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from statistics import linear_regression, quantiles

WAIT_SHARE = 0.5
"""How long a single waiting trial waits for half of the trials, in inferences. Where an inference takes as
long for many as for few, trials that miss a batch wait a whole inference longer."""
_MAX_WAIT_S = 0.25
_SPREAD = 1.5
"""Batch sizes of an inference that lie so far apart tell what an observation more costs."""
_RECENT = 8
"""Inferences of a size that are remembered, and of any size."""
_SIMULATIONS = 64


class BatchTimer:
    """Times the batches of one replica of the policy.

    Args:
        least_s: minimum time in seconds that a waiting trial waits for others.
    """

    def __init__(self, least_s: float):
        self._least_s = least_s
        self._inferences = deque[float](maxlen=_RECENT)
        self._by_size: dict[int, deque[float]] = {}
        self._simulations = deque[tuple[int, float]](maxlen=_SIMULATIONS)

    def inferred(self, batch: int, seconds: float) -> None:
        """Records the time of an inference for a batch of observations."""
        self._inferences.append(seconds)
        self._by_size.setdefault(batch, deque(maxlen=_RECENT)).append(seconds)

    def simulated(self, together: int, seconds: float) -> None:
        """Records how long a simulator took to execute an answer, and how many trials began at once."""
        self._simulations.append((together, seconds))

    def ask_at(
        self, waiting: Sequence[float], acting: Sequence[float], handing_off: int, limit: int
    ) -> float:
        """Returns when to send the batch at the latest, on the engine's clock.

        Args:
            waiting: since when each trial waits; at least one.
            acting: since when each simulator executes an answer.
            handing_off: trials whose start is being rebuilt.
            limit: most observations in a batch.

        Returns:
            The latest time to wait until; a time in the past when the batch should be sent now.
        """
        first, total = min(waiting), len(waiting) + len(acting)
        if len(waiting) >= limit or not (acting or handing_off):
            return first
        if acting and limit >= total:
            round_s = self._simulation_s(total)
            if round_s is not None and round_s <= self._fixed_s():
                return max(acting) + round_s + self._least_s  # what a reply takes on its way, too
        if len(waiting) >= min(limit, max((total + handing_off) // 2, 1)):
            return first
        return first + self.delay_s

    @property
    def delay_s(self) -> float:
        """How long a trial waits for half of the trials."""
        # The shortest of the last inferences: the first ones compile.
        usual_s = min(self._inferences, default=0.0)
        return max(self._least_s, min(WAIT_SHARE * usual_s, _MAX_WAIT_S))

    def _simulation_s(self, total: int) -> float | None:
        """Returns the 90th percentile of the simulation time, if `total` trials step at once.

        Times of fewer trials are scaled up, because more trials have to share the cores.
        """
        times = [seconds * max(1.0, total / together) for together, seconds in self._simulations]
        return quantiles(times, n=10)[-1] if len(times) > 1 else None

    def _fixed_s(self) -> float:
        """Returns the fixed time of an inference, which does not depend on the batch size.

        Until batches of different sizes have been measured, this is the time of the shortest inference.
        """
        shortest = {size: min(times) for size, times in self._by_size.items() if len(times) > 1}
        if not shortest or max(shortest) < _SPREAD * min(shortest):
            return min(self._inferences, default=0.0)
        _, fixed_s = linear_regression(list(shortest), list(shortest.values()))
        return fixed_s
