"""Follows a trial log while another process writes it, and shows how far the run is."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Protocol, TextIO

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.units import default_unit, initial_unit, unit_labels
from lerobot_roborecover.analysis.summary import rate_estimate
from lerobot_roborecover.scenario import Outcome, Start

_LINE_EVERY_S = 15.0


class LogTail:
    """Reads a growing trial log; a line that is still being written waits for its end.

    Args:
        path: the log; it need not exist yet.
    """

    def __init__(self, path: Path):
        self._path = path
        self._offset = 0

    def read(self) -> list[dict[str, Any]]:
        """Rows that were completed since the last call."""
        try:
            with open(self._path, "rb") as stream:
                stream.seek(self._offset)
                data = stream.read()
        except FileNotFoundError:
            return []
        complete = data[: data.rfind(b"\n") + 1]
        self._offset += len(complete)
        return [json.loads(line) for line in complete.splitlines()]


class RunProgress:
    """Finished trials of one start, among those that were asked for.

    Args:
        start: rows of other starts are left out.
        ids: scenarios of the run.
        trials: trials per scenario.
    """

    def __init__(self, start: str, ids: Collection[str], trials: int):
        self._start, self._ids, self._trials = start, frozenset(ids), trials
        self._seen: set[tuple[str, int]] = set()
        self._counts: dict[str, tuple[int, int]] = {}
        """Successes and trials by scenario."""
        self._valid = False
        self._units: dict[str, str] = {}
        """What is independent, by scenario, as in the table at the end."""

    def add(self, rows: list[dict[str, Any]]) -> None:
        """Counts rows in; one that was counted before changes nothing."""
        for row in rows:
            key = (row["scenario_id"], row["trial"])
            if not self.wanted(row) or key in self._seen:
                continue
            self._seen.add(key)
            self._valid |= Outcome(row["outcome"]).valid
            won, of = self._counts.get(key[0], (0, 0))
            self._counts[key[0]] = (won + row["success"], of + 1)
            cluster, platform = row.get("cluster") or "", str(row.get("platform", ""))
            unit = initial_unit(None) if self._start == Start.INITIAL else default_unit(platform)
            states = [row.get("first_state") or ""]
            (self._units[key[0]],) = unit_labels(unit, [key[0]], [cluster], [""], states)

    def wanted(self, row: dict[str, Any]) -> bool:
        """Whether a row is one of the trials asked for."""
        return row["start"] == self._start and row["scenario_id"] in self._ids and row["trial"] < self._trials

    @property
    def total(self) -> int:
        return len(self._ids) * self._trials

    @property
    def done(self) -> int:
        return len(self._seen)

    @property
    def rate(self) -> float | None:
        """Success rate so far, over scenarios that have a trial; None before a valid one."""
        return self._estimate().value if self._valid else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The rate's 95 % interval, by the estimator of the table at the end; None below two units."""
        found = self._estimate() if self._valid else None
        return None if found is None or found.low != found.low else (found.low, found.high)

    @property
    def note(self) -> str:
        """What the line says beside the rate."""
        return ""

    def _estimate(self) -> Estimate:
        counts = self._counts
        if self._start == Start.INITIAL:  # trials of one first state are one state's, whatever the scenario
            counts = {}
            for scenario, (won, of) in self._counts.items():
                before = counts.get(self._units[scenario], (0, 0))
                counts[self._units[scenario]] = (before[0] + won, before[1] + of)
        rates = np.array([won / of for won, of in counts.values()])
        return rate_estimate(rates, [self._units.get(name, name) for name in counts])


class ProgressState(Protocol):
    """How far something is, as `ProgressLine` asks."""

    @property
    def total(self) -> int:
        """Of all."""

    @property
    def done(self) -> int:
        """Finished."""

    @property
    def rate(self) -> float | None:
        """Share of successes; None before there is one."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """The rate's; None where there is none."""

    @property
    def note(self) -> str:
        """What the line says beside the rate."""


class ProgressLine:
    """One line that is kept up to date on a terminal, or repeated now and then in a file.

    Args:
        label: what is running.
        stream: where to write.
        clock: seconds, for the time left.
        detailed: with the success rate's interval, and trials per minute.
        unit: what is counted.
    """

    def __init__(
        self,
        label: str,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        detailed: bool = False,
        unit: str = "trials",
    ):
        self._label, self._clock, self._detailed, self._unit = label, clock, detailed, unit
        self._stream = stream or sys.stderr
        self._done_before: int | None = None
        self._paced_from: tuple[float, int] | None = None
        """When the first new trial ended, and how many were done then: start-up says nothing of the pace."""
        self._shown_at = float("-inf")
        self._last = ""

    def show(self, state: ProgressState, *, final: bool = False) -> None:
        """Writes the line if it says something new."""
        now = self._clock()
        if self._done_before is None:
            self._done_before = state.done
        if self._paced_from is None and state.done > self._done_before:
            self._paced_from = now, state.done
        text = self._text(state, now)
        if self._stream.isatty():
            end = "\n" if final else ""
            self._stream.write(f"\r\033[K{text}{end}")
        elif text != self._last and (final or now - self._shown_at >= _LINE_EVERY_S):
            self._stream.write(f"{text}\n")
        else:
            return
        self._stream.flush()
        self._last, self._shown_at = text, now

    def _text(self, state: ProgressState, now: float) -> str:
        """The line: trials, running rate, time left."""
        parts = [f"{self._label:<9} {state.done:>3}/{state.total} {self._unit}"]
        if state.rate is not None:
            bounds = state.interval if self._detailed else None
            interval = f" [{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]" if bounds else ""
            parts.append(f"success {100 * state.rate:.1f}{interval} % {state.note}".rstrip())
        if state.done >= state.total:
            parts.append("done")
        elif self._paced_from is None:
            parts.append("starting LeRobot and the simulators ...")
        elif state.done > self._paced_from[1]:
            since, done_then = self._paced_from
            trial_s = (now - since) / (state.done - done_then)
            left_s = trial_s * (state.total - state.done)
            if self._detailed and trial_s:
                parts.append(f"{60 / trial_s:.1f} {self._unit}/min")
            parts.append(f"about {_duration(left_s)} left")
        return "  ".join(parts)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
