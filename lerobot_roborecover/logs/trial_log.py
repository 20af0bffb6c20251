"""The trial log: one JSON line per finished trial, on disk before the next trial starts.

A rerun with the same log skips what is done. A line cut off by a crash is dropped on the next opening; every
complete line is kept. Two rows that claim the same trial with different outcomes are an error, never a
choice.
"""

from __future__ import annotations

import gc
import json
import re
import sys
import typing
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from unicodedata import normalize

from lerobot_roborecover.errors import OptionError, RoboRecoverError
from lerobot_roborecover.logs.fields import MAX_LINE_BYTES, OBJECT, FieldProblem, short_identity
from lerobot_roborecover.logs.log_file import LogFileError, LogTextError, appendable, open_log
from lerobot_roborecover.logs.row import EvalProtocol, TrialRow, row_of
from lerobot_roborecover.logs.schema import RowChecker, parse_json
from lerobot_roborecover.scenario import Outcome
from lerobot_roborecover.utils.journal import AppendOnly, InUseError, append_records, complete_lines


class TrialLogError(RoboRecoverError, ValueError):
    """A trial log cannot be used; the message says where, why and the remedy."""


@dataclass(frozen=True)
class ReadLog:
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
        """Warnings for readers of this log."""
        if not self.cut:
            return ()
        return (f"{self.path}: its last line was cut off by a crash and is left out; rerun to complete",)


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
            row = row_of(checker.check(parse_json(line)))
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
        with open_log(Path(path)) as log, _collector_paused():
            policies: dict[str, None] = {}
            lines: list[int] = []
            rows: list[TrialRow] = []
            for line, row in _checked_rows(complete_lines(log.file, MAX_LINE_BYTES), str(path)):
                policies[normalize("NFC", row.policy)] = None
                # The row is not shared yet. Canonically equal names are one name.
                object.__setattr__(row, "policy", normalize("NFC", row.policy if policy is None else policy))
                lines.append(line)
                rows.append(row)
            cut = log.cut
    except LogTextError as err:
        raise TrialLogError(f"{path}, line 1: {err}") from None
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
    """How a trial of the log ended. Apart from `TrialRow`: a run remembers no more of thousands of rows."""

    success: bool
    steps: int


class _Kind(NamedTuple):
    """What the rows of one policy, start and setting share."""

    policy: str
    """Without its hash."""
    start: str
    config_hash: str
    run_seed: int | None
    recorded: bool
    """Whether they say all of their policy's files and options, as rows since schema 3 do."""
    version: str
    """Short hash of an object or a callable that the user named; empty for other policies."""


def _nameless(policy: str) -> str:
    """A policy's name without the hashes and commits in it."""
    return re.sub(r"@[0-9a-f]{6,40}\b", "", policy)


def _version(settings: Mapping[str, Any]) -> str:
    return short_identity(str(settings.get(OBJECT, "")))


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
            appendable(self.path)
            self._file = AppendOnly(self.path)
        except LogTextError as err:
            raise TrialLogError(f"{path}, line 1: {err}") from None
        except LogFileError as err:
            raise TrialLogError(f"cannot add to trial log {path}: {err}") from None
        except InUseError:
            raise TrialLogError(
                f"trial log {path} is in use by another process. Wait for it, or give this run a "
                "log of its own "
                "(--env.trial_log) and merge them afterwards"
            ) from None
        self._done: dict[tuple, Finished] = {}
        self._kinds: Counter[_Kind] = Counter()
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

    def other_rows(self, protocol: EvalProtocol) -> list[str]:
        """Returns a line for each kind of rows of this policy and start that a run of the protocol does not
        reuse, or reuses although nothing says whose they are."""
        other = earlier = unnamed = replaced = unidentified = 0
        own, versions = _version(protocol.policy_settings), set()
        for kind, count in self._kinds.items():
            if (kind.policy, kind.start) != (_nameless(protocol.policy), protocol.start):
                continue
            if not kind.recorded:
                earlier += count
            elif kind.version and own and kind.version != own:
                replaced += count
                versions.add(kind.version)
            elif kind.config_hash != replace(protocol, run_seed=kind.run_seed).config_hash():
                other += count
            elif protocol.policy == "unknown":
                unnamed += count
            elif protocol.policy_settings.get("server_weights") == "not known":
                unidentified += count
        found = []
        if unnamed:
            found.append(
                f"nothing says which policy this run has: {unnamed} row(s) in {self.path}, of a run that did "
                "not say it either, are taken for its own. Give each policy a log of its own "
                "(--env.trial_log)"
            )
        if unidentified:
            found.append(
                f"the policy server has no identity: {unidentified} row(s) of {protocol.policy} in "
                f"{self.path} are taken for its own, whatever has changed. Have the server tell an "
                "`identity`, or give a changed one another --policy.name"
            )
        if replaced:
            found.append(
                f"this is version {own} of {protocol.policy}: {replaced} row(s) of version "
                f"{', '.join(sorted(versions))} stay in {self.path} and are not reused; reports number the "
                "versions and mark the newest"
            )
        if other:
            found.append(
                f"{other} row(s) of this policy under other settings are in {self.path} and are not reused"
            )
        if earlier:
            found.append(
                f"{earlier} row(s) of this policy in {self.path} were written by an earlier version, do not "
                "say which files and options the policy had, and are not reused; to keep them apart, give "
                "this run a log of its own (--env.trial_log)"
            )
        return found

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
            self._file.replace(json.dumps(asdict(r), allow_nan=False).encode() for r in kept)
            for key in out:
                del self._done[key]
        return len(gone)

    def _remember(self, row: TrialRow) -> None:
        self._done[tuple(sys.intern(p) if isinstance(p, str) else p for p in row.key())] = Finished(
            row.success, row.steps
        )
        if "fork" not in row.options:  # forks are trials of their own
            kind = _Kind(
                _nameless(row.policy),
                row.start,
                row.config_hash,
                row.run_seed,
                row.policy_settings is not None,
                _version(row.policy_settings or {}),
            )
            self._kinds[kind] += 1

    def close(self) -> None:
        self._file.close()
