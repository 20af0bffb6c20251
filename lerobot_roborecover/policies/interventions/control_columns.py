"""A decision of a policy that intervenes, as columns behind its action: for LeRobot's own loop alone.

An action array is all that LeRobot's loop carries from a policy to an environment. In it the composite policy
appends five columns, which the vector env takes off before the action reaches a simulator. `roborecover eval`
passes the decisions themselves (`policies.runner`).

1. a signature, so that a policy of the wrong width is never read as a decision;
2. rollback: 0 goes on with the action, k > 0 puts the simulation k steps back instead of acting, -1 does so
   by the paper's rule for the task;
3. who acts: a `Controller`;
4. the monitor's score of the observation that the action answers: -1 where it was not asked, NaN where its
   answer could not be read;
5. seconds the monitor took, shared by the batch.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_roborecover.policies.runner import BY_RULE, Act, Controller, InterventionMark, Rollback

SIGNATURE = 21074.0
"""Exact in float32, and beyond any action (`rollout.MAX_ACTION_MAGNITUDE`)."""
WIDTH = 5
_NOT_ASKED = -1.0


def append_columns(decision: Act | Rollback, width: int) -> np.ndarray:
    """(n, A + 5): the decision's actions with their columns; a rollback is one row of zeros.

    Args:
        decision: its mark stands beside the first action alone; the others share its controller.
        width: A.
    """
    if isinstance(decision, Rollback):
        steps = BY_RULE if decision.steps is None else decision.steps
        return np.concatenate(
            [np.zeros((1, width), np.float32), np.asarray([_columns(decision.mark, steps)], np.float32)],
            axis=1,
        )
    first = decision.mark or InterventionMark()
    rest = _columns(InterventionMark(first.controller))
    columns = [_columns(first), *[rest] * (len(decision.actions) - 1)]
    return np.concatenate([decision.actions, np.asarray(columns, decision.actions.dtype)], axis=1)


def strip_columns(rows: Any, width: int) -> list[Act | Rollback]:
    """Reads the columns; one decision per row.

    Args:
        rows: (n, A) or (n, A + 5).
        width: A.

    Returns:
        Rows whose columns cannot be read come back as actions without a mark: their width is then wrong.
    """
    plain: list[Act | Rollback] = [Act(rows[i : i + 1]) for i in range(len(rows) if np.ndim(rows) else 0)]
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.dtype.kind != "f":
        return plain
    if rows.shape[1] != width + WIDTH or not np.all(rows[:, width] == SIGNATURE):
        return plain
    try:
        return [_read(row[None, :width], row[width:].astype(np.float64)) for row in rows]
    except (ValueError, OverflowError):  # no number of steps, or no controller
        return plain


def _columns(mark: InterventionMark, rollback: int = 0) -> list[float]:
    score = mark.score if mark.asked else _NOT_ASKED
    return [SIGNATURE, float(rollback), float(mark.controller), score, mark.monitor_s]


def _read(action: np.ndarray, columns: np.ndarray) -> Act | Rollback:
    _, rollback, controller, score, seconds = columns.tolist()
    mark = InterventionMark(Controller(int(controller)), monitor_s=seconds)
    if score != _NOT_ASKED:
        mark = replace(mark, asked=True, score=score)
    steps = int(rollback)
    if steps < BY_RULE:
        raise ValueError(f"a rollback of {steps} steps")
    if not steps:
        return Act(action, mark)
    return Rollback(None if steps == BY_RULE else steps, mark)
