"""LIBERO's settling no-ops, recognised in recorded actions."""

from __future__ import annotations

import numpy as np

_MOST = 10
"""No-ops at the start of an episode (LeRobot and the paper's release)."""


def leading_no_ops(actions: np.ndarray) -> int:
    """How many of the first ten actions are no-ops with an open gripper, before the first that is not.

    Args:
        actions: (T, 7) float64.
    """
    still = (actions[:_MOST] == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]).all(axis=1)
    return int(still.argmin()) if not still.all() else len(still)
