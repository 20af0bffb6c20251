"""Progress of long work on standard error: a bar with the time left, from counts that the work reports."""

from __future__ import annotations

import sys

from tqdm import tqdm

_ON_A_TERMINAL_S, _IN_LOGS_S = 0.2, 10.0
"""Between two pictures of a bar."""


class Progress:
    """Bars, one for each thing counted, the next below the last.

    Args:
        unit: what is counted.
    """

    def __init__(self, unit: str):
        self._unit, self._what = unit, ""
        self._bar: tqdm | None = None

    def __call__(self, done: int, total: int) -> None:
        """So many are done."""
        self.of("", done, total)

    def of(self, what: str, done: int, total: int) -> None:
        """So many are done of one thing.

        Args:
            what: the bar's name; another one than before begins a bar of its own.
            done: so far.
            total: of them.
        """
        if self._bar is None or what != self._what:
            self.close()
            self._what = what
            self._bar = tqdm(
                total=total, desc=what or None, unit=f" {self._unit}", file=sys.stderr, disable=False,
                mininterval=_ON_A_TERMINAL_S if sys.stderr.isatty() else _IN_LOGS_S,
            )  # fmt: skip
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar, self._what = None, ""
