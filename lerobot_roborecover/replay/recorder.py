"""Records what a simulator goes through, step by step: the one recorder.

Exact actions, poses, the task's predicate, and what became of each action; what is replayed later, judged by
rules, or written as a candidate dataset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lerobot_roborecover.platforms.simulator import Simulator
from lerobot_roborecover.scenario import Pose, Reset, Rollout, Task

UNPERTURBED, PERTURBED, UNREACHABLE = 0, 1, 2
"""What became of one action: executed as given; perturbed; to be perturbed, but not reachable then, so
that it was executed as given (paper, "Action-Perturbed Scenarios")."""


@dataclass(frozen=True)
class Steps:
    """One rollout of T actions, step by step."""

    bodies: Mapping[str, np.ndarray]
    """(T + 1, 7) float64 by name: position in metres and quaternion xyzw; `eef...` are end effectors."""
    solved: np.ndarray
    """(T + 1,) bool: the task's predicate."""
    perturbation: np.ndarray
    """(T,) int8: `UNPERTURBED`, `PERTURBED` or `UNREACHABLE`."""

    def poses_at(self, step: int) -> dict[str, Pose]:
        """Poses after `step` actions."""
        return {n: Pose(tuple(p[step, :3]), tuple(p[step, 3:])) for n, p in self.bodies.items()}


class Recorder:
    """Drives a simulator and records it; after T actions there are T + 1 states.

    Args:
        simulator: of any platform; a caller that steps it directly reports the action with `note`.
    """

    def __init__(self, simulator: Simulator):
        self.simulator = simulator
        self._task: Task | None = None
        self._reset = Reset()
        self.actions: list[np.ndarray] = []
        """T executed actions, (A,) float64."""
        self.flags: list[int] = []
        """T marks: `UNPERTURBED`, `PERTURBED` or `UNREACHABLE`."""
        self.bodies: list[dict[str, Pose]] = []
        """T + 1 poses by name."""
        self.solved: list[bool] = []
        """T + 1 values of the task's predicate."""

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def reset_record(self) -> Reset:
        """The reset, with what the simulator has drawn at random (LIBERO's fixtures)."""
        return self._reset

    def reset(self, task: Task, reset: Reset) -> None:
        """Resets the simulator and begins a record."""
        self.clear()
        self.simulator.reset(task, reset)
        self._task = task
        self._reset = reset if reset.fixtures else replace(reset, fixtures=dict(self.simulator.fixtures()))
        self._look()

    def clear(self) -> None:
        """Forgets the record."""
        self._task = None
        for kept in (self.actions, self.flags, self.bodies, self.solved):
            kept.clear()

    def step(self, action: np.ndarray, flag: int = UNPERTURBED) -> None:
        """Executes an action in float64 and records it."""
        action = np.array(action, dtype=np.float64)
        self.simulator.step(action)
        self.note(action, flag)

    def note(self, action: np.ndarray, flag: int = UNPERTURBED) -> None:
        """Records an action that the simulator has just executed."""
        self.actions.append(np.array(action, dtype=np.float64))
        self.flags.append(flag)
        self._look()

    def cut(self, step: int) -> None:
        """Forgets what came after a step; the simulator is there again."""
        del self.actions[step:], self.flags[step:], self.bodies[step + 1 :], self.solved[step + 1 :]

    @property
    def rollout(self) -> Rollout:
        """Task, reset and actions, for replay.

        Raises:
            ScenarioError: there are too many actions, or one is not finite.
        """
        assert self._task is not None, "nothing was recorded"
        width = len(self.actions[0]) if self.actions else self.simulator.action_dim
        return Rollout(self._task, self._reset, np.array(self.actions, np.float64).reshape(-1, width))

    @property
    def steps(self) -> Steps:
        """What happened, step by step."""
        names = list(self.bodies[0])
        poses = [[[*b[name].position_m, *b[name].quat_xyzw] for b in self.bodies] for name in names]
        return Steps(
            {name: np.array(path) for name, path in zip(names, poses, strict=True)},
            np.array(self.solved),
            np.array(self.flags, np.int8),
        )

    def _look(self) -> None:
        self.bodies.append(self.simulator.bodies())
        self.solved.append(bool(self.simulator.succeeded()))
