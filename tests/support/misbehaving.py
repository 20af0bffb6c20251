"""Answers of policies that misbehave, for every loop that takes a policy's actions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

BAD_ROWS: dict[str, tuple[Callable[[np.ndarray], object], str]] = {
    "a row too few": (lambda rows: rows[:-1], "rows of actions for"),
    "a row too many": (lambda rows: np.concatenate([rows, rows[:1]]), "rows of actions for"),
    "one column": (lambda rows: rows[:, :1], "(2,)"),
    "a column too many": (lambda rows: np.concatenate([rows, rows[:, :1]], axis=1), "(2,)"),
    "no column axis": (lambda rows: rows[:, 0], "(n, 2)"),
    "complex": (lambda rows: rows + 1j, "complex64; actions are real numbers"),
    "objects": (lambda rows: rows.astype(object), "object; actions are real numbers"),
    "truth values": (lambda rows: rows > 0, "bool; actions are real numbers"),
    "text": (lambda rows: rows.astype(str), "actions are real numbers"),
    "NaN": (lambda rows: np.full_like(rows, np.nan), "non-finite action [nan, nan]"),
    "infinity": (lambda rows: np.full_like(rows, -np.inf), "non-finite action [-inf, -inf]"),
}
"""Makes of (B, 2) good actions what a policy must not give, and says what the trials' rows say of it."""
