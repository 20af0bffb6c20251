"""The trial log: one JSON line per finished trial, on disk before the next trial starts.

A rerun with the same log skips what is done. A line cut off by a crash is dropped on the next opening; every
complete line is kept. Two rows that claim the same trial with different outcomes are an error, never a
choice.
"""

from __future__ import annotations

import gc
import hashlib
import json
import os
import sys
import typing
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_roborecover.env.trial_check import (
    MAX_LINE_BYTES,
    MAX_TEXT,
    TRIAL_SCHEMA,
    FieldProblem,
    RowChecker,
    parse_json,
)
from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.journal import AppendOnly, InUseError, append_records, complete_lines
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.replay import Handoff
from lerobot_roborecover.scenario import Outcome, TrialStart
from lerobot_roborecover.whole import write_whole


class TrialLogError(RoboRecoverError, ValueError):
    """A trial log cannot be used; the message says where, why and the remedy."""


@dataclass(frozen=True)
class Protocol:
    """What a run holds fixed for all its trials; part of every row and of the key that resumes it."""

    start: str
    """`recovery`, `initial` or `reversion`."""
    rewind_steps: int | None
    """Steps before the recovery point, for `reversion`; None follows the paper's rule by scenario. Otherwise
    0."""
    policy: str
    """Who was evaluated: path or Hub id, with a content hash or revision where known."""
    run_seed: int | None
    """Seed of the run; None where the caller gave none."""
    execution_horizon: int | None
    """Actions executed per inference (`n_action_steps`), where the policy says."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What else decides a result: observation size, control mode, handoff check, and the like."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Packages that decide scores."""

    def rewind_for(self, scenario: TrialStart) -> int:
        """Steps before the recovery point on this scenario, before the task's start limits them."""
        if self.rewind_steps is None:
            return platform_named(scenario.platform).rewind_steps(scenario.task.horizon)
        return self.rewind_steps

    def config_hash(self) -> str:
        """Short hash of everything above."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class TrialRow:
    """One finished trial. Flat, so that a log loads into any table library as it is.

    Rows of one log share equal texts, `options` and `versions`; nobody changes these in place.
    """

    schema: int
    """Version of this layout."""
    scenario_id: str
    scenario_sha256: str
    dataset: str
    """Where the scenario came from."""
    dataset_revision: str | None
    platform: str
    suite: str
    task: str
    instruction: str
    stage: str
    deviation: str
    source: str
    source_policy: str
    cluster: str
    split: str
    start: str
    rewind_steps: int
    """Steps before the recovery point that were asked for; a shorter prefix starts at its beginning."""
    handoff_step: int
    """Prefix actions replayed before the policy took over."""
    trial: int
    """k: index of the trial within its scenario, from 0."""
    run_seed: int | None
    trial_seed: int | None
    """Seed derived from (run seed, scenario, k)."""
    noise: str
    """`per_trial`: torch's generator was set for this trial alone; `per_batch`: for the batch it ran in, so a
    policy that draws from it depends on the batch; `unseeded`: the run had no seed."""
    batch_size: int
    """Trials that shared a policy batch, at most."""
    outcome: str
    """A `scenario.Outcome`."""
    success: bool
    reason: str
    """Why, for an invalid outcome."""
    steps: int
    """New environment steps; replayed ones do not count."""
    horizon: int
    handoff_eef_error_mm: float | None
    handoff_object_error_mm: float | None
    handoff_identical: bool | None
    handoff_from_snapshot: bool | None
    handoff_s: float | None
    sim_s: float
    policy_s: float
    """Wall time between the environment's reply and the next action, shared by the batch."""
    actions_sha256: str
    """Hash of the executed actions, float32 or float64 as the policy gave them."""
    interventions: list
    """Kind and step of every intervention; empty for direct control."""
    policy: str
    execution_horizon: int | None
    options: dict
    """What else decides a result: picture size, control mode, handoff check, and the like."""
    versions: dict
    config_hash: str
    finished_at: str
    """UTC, ISO 8601."""
    progress: list | None
    """How much of the task was done where the policy took over, and after each of its steps, in whole per
    cent; None where the platform does not tell, and in logs of schema 1. A rollback puts the number of the
    state that it went to in place of the last one."""

    def key(self) -> tuple:
        """What makes it the same trial: a rerun that meets the key again skips it."""
        return trial_key(self.scenario_sha256, self.scenario_id, self.config_hash, self.trial)


def trial_key(scenario_sha256: str, scenario_id: str, config_hash: str, trial: int) -> tuple:
    """Identity of a trial within a log."""
    return (scenario_sha256, scenario_id, config_hash, trial)


def trial_seed(run_seed: int | None, scenario_id: str, trial: int) -> int | None:
    """63-bit seed of trial k of a scenario, from (run seed, scenario, k) alone."""
    if run_seed is None:
        return None
    digest = hashlib.sha256(f"{run_seed}/{scenario_id}/{trial}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def make_row(
    scenario: TrialStart,
    protocol: Protocol,
    *,
    dataset: str,
    dataset_revision: str | None,
    trial: int,
    noise: str,
    batch_size: int,
    outcome: Outcome,
    reason: str,
    steps: int,
    handoff: Handoff | None,
    sim_s: float,
    policy_s: float,
    actions_sha256: str,
    interventions: Iterable = (),
    progress: Sequence[int] | None = None,
) -> TrialRow:
    """The one place where a trial row is built."""
    labels = scenario.labels
    return TrialRow(
        schema=TRIAL_SCHEMA,
        scenario_id=scenario.id,
        scenario_sha256=scenario.sha256(),
        dataset=_writable(dataset),
        dataset_revision=dataset_revision,
        platform=scenario.platform,
        suite=scenario.task.suite,
        task=scenario.task.name,
        instruction=scenario.task.instruction,
        stage=labels.stage,
        deviation=labels.deviation,
        source=labels.source,
        source_policy=labels.source_policy,
        cluster=labels.cluster,
        split=labels.split,
        start=protocol.start,
        rewind_steps=protocol.rewind_for(scenario),
        handoff_step=handoff.step if handoff else 0,
        trial=trial,
        run_seed=protocol.run_seed,
        trial_seed=trial_seed(protocol.run_seed, scenario.id, trial),
        noise=noise,
        batch_size=batch_size,
        outcome=outcome.value,
        success=outcome is Outcome.SUCCESS,
        # What broke a trial may have said anything, and must not make its row one that nobody can read.
        reason=reason[:MAX_TEXT].encode(errors="replace").decode(),
        steps=steps,
        horizon=scenario.task.horizon,
        handoff_eef_error_mm=handoff.eef_error_mm if handoff else None,
        handoff_object_error_mm=handoff.object_error_mm if handoff else None,
        handoff_identical=handoff.identical if handoff else None,
        handoff_from_snapshot=handoff.from_snapshot if handoff else None,
        handoff_s=round(handoff.seconds, 4) if handoff else None,
        sim_s=round(sim_s, 4),
        policy_s=round(policy_s, 4),
        actions_sha256=actions_sha256,
        interventions=list(interventions),
        policy=_writable(protocol.policy),
        execution_horizon=protocol.execution_horizon,
        options=dict(protocol.options),
        versions=dict(protocol.versions),
        config_hash=protocol.config_hash(),
        finished_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        progress=None if progress is None else list(progress),
    )


def _writable(name: str) -> str:
    """A name as a log takes it: what a path or an error message holds beyond printable text is replaced."""
    return name if name.isprintable() else "".join(c if c.isprintable() else "\ufffd" for c in name)


@dataclass(frozen=True)
class ReadLog:
    """A log as it was read."""

    path: Path
    rows: tuple[TrialRow, ...]
    """One of each trial."""
    lines: tuple[int, ...]
    """Where each row stands, from 1."""
    policies: tuple[str, ...]
    """Whose rows these are, in the log's own words."""
    cut: bool
    """Whether the last line lacks its end, as after a crash; it is left out of the rows."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What whoever uses the rows has to know about the file."""
        if not self.cut:
            return ()
        return (f"{self.path}: its last line was cut off by a crash and is left out; rerun to complete",)


_SETTERS = tuple((f.name, getattr(TrialRow, f.name).__set__) for f in fields(TrialRow))


def _row_of(record: Mapping[str, Any]) -> TrialRow:
    """A row of checked fields; a frozen dataclass's own `__init__` takes eight times as long."""
    row = object.__new__(TrialRow)
    for name, put in _SETTERS:
        put(row, record[name])
    return row


def _checked_rows(lines: Iterable[bytes], where: str) -> Iterator[tuple[int, TrialRow]]:
    """The rows of complete lines and their line numbers, one row of each trial.

    Raises:
        TrialLogError: a line is not a trial row, or two rows disagree about one trial.
    """
    ended: dict[tuple, tuple[int, str, int]] = {}
    checker = RowChecker()
    for number, line in enumerate(lines, 1):
        try:
            if len(line) > MAX_LINE_BYTES:
                raise FieldProblem(
                    f"longer than {MAX_LINE_BYTES} bytes; this is not a trial log. Name another"
                )
            row = _row_of(checker.check(parse_json(line)))
        except FieldProblem as err:
            raise TrialLogError(f"{where}, line {number}: {err}") from None
        key = row.key()
        before = ended.setdefault(key, (number, row.outcome, row.steps))
        if before[1:] != (row.outcome, row.steps):
            raise TrialLogError(
                f"{where}, line {number}: field 'outcome': trial {row.trial} of {row.scenario_id} ended as "
                f"{row.outcome!r} after {row.steps} steps here and as {before[1]!r} after {before[2]} "
                f"before, in line {before[0]}. One of the two is wrong; keep the logs apart"
            )
        if before[0] == number:
            yield number, row


def read_log(path: Path, policy: str | None = None) -> ReadLog:
    """A log on disk: its complete rows, where they stand, and whether its last line was cut off.

    Args:
        path: the file.
        policy: name that takes the place of the rows' own.

    Raises:
        TrialLogError: the file cannot be read as a trial log; names the line and the field.
    """
    try:
        with open(path, "rb") as file, _collector_paused():
            policies: dict[str, None] = {}
            lines: list[int] = []
            rows: list[TrialRow] = []
            for line, row in _checked_rows(complete_lines(file, MAX_LINE_BYTES), str(path)):
                policies[row.policy] = None
                if policy is not None:
                    object.__setattr__(row, "policy", policy)  # nobody has seen the row yet
                lines.append(line)
                rows.append(row)
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            cut = file.read(1) not in (b"\n", b"")
    except (OSError, ValueError) as err:  # ValueError: a path with a NUL
        if isinstance(err, TrialLogError):
            raise
        raise TrialLogError(f"cannot read trial log {path}: {err}") from None
    return ReadLog(Path(path), tuple(rows), tuple(lines), tuple(policies), cut)


@contextmanager
def _collector_paused() -> Generator[None]:
    """Rows hold no cycles; to look for some again and again takes a third of a long log's time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def read_trial_log(path: Path) -> list[TrialRow]:
    """All complete rows of a log on disk.

    Raises:
        TrialLogError: the file cannot be read as a trial log; names the line and the field.
    """
    return list(read_log(path).rows)


def check_retry(outcomes: Iterable[str]) -> frozenset[str]:
    """Outcomes whose trials are to run again.

    Args:
        outcomes: of `--retry`.

    Raises:
        OptionError: one is unknown, or of trials that count as they are.
    """
    found = frozenset(outcomes)
    for outcome in sorted(found):
        if outcome not in list(Outcome) or Outcome(outcome).valid:
            raise OptionError(
                f"--retry {outcome!r:.40}: not one of {[o.value for o in Outcome if not o.valid]}; trials "
                "that are valid are never run again"
            )
    return found


class Finished(NamedTuple):
    """How a trial of the log ended; all that a run remembers of its rows."""

    success: bool
    steps: int


class RowLog(typing.Protocol):
    """Where a run's rows go."""

    path: Path

    @property
    def rows(self) -> list[TrialRow]:
        """All rows, in the order they were written."""

    def find(self, key: tuple) -> Finished | None:
        """How a trial ended that is already done, else None."""

    def append(self, row: TrialRow) -> None:
        """Writes a row and waits until it is on disk."""


class TrialLog:
    """An open log that takes rows; only one process may hold it.

    Rows stay on disk: a run of ten thousand trials takes no more memory than one of a hundred.

    Args:
        path: the file; its folder is made if need be.

    Raises:
        TrialLogError: the log is damaged, or another process has it open.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        try:
            self._file = AppendOnly(self.path)
        except InUseError:
            raise TrialLogError(
                f"trial log {path} is in use by another process. Wait for it, or give this run a "
                "log of its own "
                "(--env.trial_log) and merge them afterwards"
            ) from None
        self._done: dict[tuple, Finished] = {}
        try:
            for _, row in _checked_rows(self._file.lines(MAX_LINE_BYTES), str(self.path)):
                self._remember(row)
        except TrialLogError:
            self._file.close()
            raise
        self.dropped_bytes = self._file.cut()

    def __len__(self) -> int:
        return len(self._done)

    @property
    def rows(self) -> list[TrialRow]:
        """All rows, in the order they were written; read from the file."""
        return read_trial_log(self.path)

    def find(self, key: tuple) -> Finished | None:
        """How a trial ended that is already done, else None."""
        return self._done.get(key)

    def append(self, row: TrialRow) -> None:
        """Writes a row and waits until it is on disk."""
        if row.key() in self._done:
            raise TrialLogError(f"trial {row.trial} of {row.scenario_id} is already in {self.path}")
        self._file.append(json.dumps(asdict(row), allow_nan=False).encode())
        self._remember(row)

    def set_aside(self, outcomes: Collection[str], to: Path, config_hash: str = "") -> int:
        """Takes rows of invalid outcomes out, so that their trials run again; they are kept in another file.

        Args:
            outcomes: which; see `check_retry`.
            to: the file that gets their rows, after those that it holds.
            config_hash: of one protocol; empty takes all.

        Returns:
            How many rows these are.
        """
        rows = self.rows
        gone = [r for r in rows if r.outcome in outcomes and config_hash in ("", r.config_hash)]
        if gone:
            out = {r.key() for r in gone}
            kept = [r for r in rows if r.key() not in out]
            append_records(to, *map(asdict, gone))
            self._file.close()
            write_whole(self.path, "".join(json.dumps(asdict(r), allow_nan=False) + "\n" for r in kept))
            self._file = AppendOnly(self.path)
            for key in out:
                del self._done[key]
        return len(gone)

    def _remember(self, row: TrialRow) -> None:
        self._done[tuple(sys.intern(p) if isinstance(p, str) else p for p in row.key())] = Finished(
            row.success, row.steps
        )

    def close(self) -> None:
        """Releases the file."""
        self._file.close()
