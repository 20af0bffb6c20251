"""Takes a trial some steps back: to the state that it had then, bit for bit.

Where the simulator's snapshots are exact, one is kept from before each of the last steps; going back restores
it and takes that one step again, which also regenerates observation clocks, contacts and the predicate. Where
they are not (SAPIEN), or further back than they are kept, the task is reset and prefix and executed actions
are replayed. Either way the state's hash must be the one that was seen on the way out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.platforms.simulator import ControlModes, Simulator, SimulatorError, advance
from lerobot_roborecover.replay.handoff import SnapshotCache, replay_to
from lerobot_roborecover.scenario import Rollout


@dataclass(frozen=True)
class RollbackResult:
    """How a rollback went."""

    distance: int
    """Steps gone back; fewer than asked for where there are not as many."""
    undone: int
    """Those of them that were taken after the handoff; the others are of the prefix."""
    method: str
    """`snapshot`, or `replay` from the reset."""


class RollbackHistory:
    """A trial's steps since its handoff. Apart from `Trial`: it lives in the simulator's process, with its
    snapshots.

    Args:
        simulator: at the handoff.
        rollout: what led there, and on from there.
        handoff_step: of its actions, so many were replayed.
        keep: how many steps back a snapshot should reach; 0 keeps none.
        cache: of handoff snapshots, for rollbacks into the prefix.
        control_mode: how actions after the handoff are read, where the simulator has more than one way.
    """

    def __init__(
        self,
        simulator: Simulator,
        rollout: Rollout,
        handoff_step: int,
        *,
        keep: int = 0,
        cache: SnapshotCache | None = None,
        control_mode: str | None = None,
    ):
        self._simulator, self._rollout, self._cache = simulator, rollout, cache
        self._control_mode = control_mode
        self._from = handoff_step
        self._actions: list[np.ndarray] = []
        self._keep = keep
        exact = keep > 0 and simulator.snapshot_is_exact
        # One more than `keep`: going k back starts from the snapshot of k + 1 steps ago.
        self._ring: deque[tuple[int, bytes]] = deque(maxlen=keep + 1 if exact else 0)
        self._states: list[str] = []
        self.set_control_mode()

    @property
    def position(self) -> int:
        """Steps since the task's reset."""
        return self._from + len(self._actions)

    def set_control_mode(self) -> None:
        """Has the simulator read actions as the policy gives them."""
        if self._control_mode is not None and isinstance(self._simulator, ControlModes):
            self._simulator.set_control_mode(self._control_mode)

    def step(self, action: np.ndarray) -> None:
        if self._ring.maxlen:
            self._ring.append((self.position, self._simulator.snapshot()))
        self._simulator.step(action)
        self._actions.append(np.array(action))
        if self._keep:
            self._states.append(self._simulator.state_sha256())

    def roll_back(self, steps: int) -> RollbackResult:
        """Goes back, at most to where an initial-state trial would start.

        Args:
            steps: how many; where there are fewer, all there are.

        Raises:
            SimulatorError: the state is not the one that it was; the trial cannot go on.
        """
        target = max(self.position - steps, self._rollout.reset.settle_steps)
        distance = self.position - target
        if not distance:
            return RollbackResult(0, 0, "snapshot")
        count = max(target - self._from, 0)
        undone = len(self._actions) - count
        expected = self._states[count - 1] if self._states and count else None
        method = "snapshot" if self._restore(target, expected) else "replay"
        if method == "replay":
            state = self._replay(target, count)
            if expected is not None and state != expected:
                raise SimulatorError(
                    f"{self._rollout.task.name}: replaying {target} steps after a rollback did not give the "
                    "state that they had given before; this simulator does not replay exactly "
                    "(roborecover doctor)"
                )
        self._from = min(self._from, target)
        del self._actions[count:], self._states[count:]
        while self._ring and self._ring[-1][0] >= target:
            self._ring.pop()
        return RollbackResult(distance, undone, method)

    def _restore(self, target: int, expected: str | None) -> bool:
        """Whether a kept snapshot led to the target."""
        for position, snapshot in self._ring:
            if position == target - 1:
                self._simulator.restore(snapshot)
                self._simulator.step(self._actions[position - self._from])
                return self._simulator.state_sha256() == expected
        return False

    def _replay(self, target: int, count: int) -> str:
        state, _ = replay_to(self._simulator, self._rollout, min(target, self._from), self._cache)
        self.set_control_mode()
        advance(self._simulator, self._actions[:count])
        return self._simulator.state_sha256() if count else state
