"""What a policy that intervenes tells the environment, in columns behind its action.

An action array is all that LeRobot's loop carries from a policy to an environment. A composite policy appends
five columns to it, which the environment takes off before the action reaches a simulator:

1. a signature, so that a policy of the wrong width is never read as a directive;
2. rollback: 0 goes on with the action, k > 0 puts the simulation k steps back instead of acting, -1 does so
   by the paper's rule for the task;
3. who acts: a `Controller`;
4. the monitor's score of the observation that the action answers: -1 where it was not asked, NaN where its
   answer could not be read;
5. seconds the monitor took, shared by the batch.

Pure: numpy only, for simulator workers and for tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

SIGNATURE = 21074.0
"""Exact in float32, and beyond any action (`rollout.MAX_ACTION_MAGNITUDE`)."""
WIDTH = 5
BY_RULE = -1
"""Rollback by `Platform.rewind_steps`."""
_NOT_ASKED = -1.0


class Controller(IntEnum):
    """Who chose an action."""

    BASE = 0
    CORRECTION = 1
    HUMAN = 2


@dataclass(frozen=True)
class ControlColumns:
    """One row's columns."""

    rollback: int = 0
    """Steps to go back instead of acting; 0 acts, `BY_RULE` asks the rule."""
    controller: Controller = Controller.BASE
    asked: bool = False
    """Whether the monitor was asked."""
    score: float = float("nan")
    """Its score; NaN where it was not asked or its answer could not be read."""
    monitor_s: float = 0.0
    """Seconds it took."""

    def columns(self) -> list[float]:
        """The row's five columns."""
        score = self.score if self.asked else _NOT_ASKED
        return [SIGNATURE, float(self.rollback), float(self.controller), score, self.monitor_s]


def append_columns(actions: np.ndarray, first: ControlColumns) -> np.ndarray:
    """(n, A + 5): actions with their directives; what the monitor said stands beside the first alone.

    Args:
        actions: (n, A).
        first: of the first action; the others share its controller.
    """
    rest = ControlColumns(controller=first.controller).columns()
    columns = [first.columns(), *[rest] * (len(actions) - 1)]
    return np.concatenate([actions, np.asarray(columns, actions.dtype)], axis=1)


def strip_columns(rows: np.ndarray, width: int) -> tuple[np.ndarray, list[ControlColumns] | None]:
    """Takes the directives off.

    Args:
        rows: (n, A) or (n, A + 5).
        width: A.

    Returns:
        (n, A) actions, and n directives; None, and the rows as they are, where they carry none that can be
        read: their width is then wrong.
    """
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.dtype.kind != "f":
        return rows, None
    if rows.shape[1] != width + WIDTH or not np.all(rows[:, width] == SIGNATURE):
        return rows, None
    try:
        return rows[:, :width], [_read(row) for row in rows[:, width:].astype(np.float64)]
    except (ValueError, OverflowError):  # no whole number of steps, or no controller
        return rows, None


def _read(columns: np.ndarray) -> ControlColumns:
    _, rollback, controller, score, seconds = columns.tolist()
    asked = score != _NOT_ASKED
    return ControlColumns(
        int(rollback), Controller(int(controller)), asked, score if asked else float("nan"), seconds
    )
