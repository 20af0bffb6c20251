"""A leaderboard from many trial logs: one board per set-up that may be compared, provenance in every row.

Logs on one board share platform, simulator versions and the scenario set, which is known by the hashes of its
scenarios' content: a log with one scenario more or another is of another set, and gets a board of its own. A
log of a part of a set is an incomplete entry of the board of that set, unless more policies were run on
exactly that part than on the whole. A log that cannot be read is listed with its reason; it never takes the
others down.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.board import Board, BoardTrials, ScenarioHashes, make_board
from lerobot_roborecover.analysis.first_states import with_first_states
from lerobot_roborecover.analysis.logs import clock_of
from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.labels import tell_settings_apart
from lerobot_roborecover.logs.fields import settings_of_method
from lerobot_roborecover.logs.log_file import LOG_SUFFIXES
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord, read_record
from lerobot_roborecover.logs.trial_log import ReadLog, TrialLogError, read_log
from lerobot_roborecover.scenario import Start

LEADERBOARD_SCHEMA = 1


@dataclass(frozen=True)
class Leaderboard:
    """All boards of a folder, and what could not be used."""

    boards: tuple[Board, ...]
    refused: tuple[tuple[str, str], ...]
    """File name and reason."""
    trials: tuple[BoardTrials, ...] = ()
    """Trials of each board."""


def make_leaderboard(
    folder: Path, options: Options | None = None, methods: Sequence[str] = ()
) -> Leaderboard:
    """Reads every `.jsonl` below a folder, compressed ones (`.gz`, `.zst`) too.

    Args:
        folder: where the logs are, at any depth.
        options: draws, seed, level, scheduled trials.
        methods: `METHOD=LOG,LOG,...` each: logs below the folder, or folders of them, that are the runs of
            one method and make one entry.

    Raises:
        RowsError: the folder does not exist, or holds no log at all; or a method's log is not there.
    """
    options = options or Options()
    files = sorted(p for s in LOG_SUFFIXES for p in folder.rglob(f"*{s}")) if folder.is_dir() else []
    if not files:
        raise RowsError(f"no trial logs (*.jsonl) below {folder}")
    run_of_file = _methods(folder, files, methods)
    records: list[SequentialRecord] = []
    run_of: dict[int, str] = {}
    """Names of the runs of methods, by the identity of a row."""
    refused: list[tuple[str, str]] = []
    groups: dict[tuple, dict[tuple, dict[tuple, tuple[TrialRow, str]]]] = {}
    contradicted: dict[tuple, str] = {}
    logs: dict[tuple, dict[str, None]] = {}
    read: list[ReadLog] = []
    digests: list[tuple[str, str]] = []
    """Name and hash of the file of every log in `read`."""
    for path in files:
        name = str(path.relative_to(folder))
        try:
            log = read_log(path)
            if (record := read_record(path)) is not None:
                records.append(record)
            digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        except (TrialLogError, OSError) as err:
            refused.append((name, str(err)))
            continue
        if not log.rows:
            refused.append((name, "it holds no complete row"))
        read.append(log)
        digests.append((name, digest))
    read, _ = with_first_states(read)
    tell_settings_apart([row for log in read if log.path not in run_of_file for row in log.rows])
    for log, (name, digest) in zip(read, digests, strict=True):
        method, run = run_of_file.get(log.path, ("", ""))
        for row in log.rows:
            run_of[id(row)] = run
            key = _board_key(row), _entry_key(row, method)
            other, first = (
                groups.setdefault(key[0], {})
                .setdefault(key[1], {})
                .setdefault((run, row.start, row.rewind_steps, *row.key()), (row, name))
            )
            if (other.outcome, other.steps) != (row.outcome, row.steps):
                contradicted.setdefault(
                    key, f"{first} and {name} contradict each other on trial {row.trial} of {row.scenario_id}"
                )
            logs.setdefault(key, {})[f"{name} {digest}"] = None
    for (board, entry), reason in contradicted.items():
        refused.append((entry[0], f"{reason}; neither is used for this policy. Take the wrong one away"))
        del groups[board][entry]
    boards: list[tuple[Board, BoardTrials]] = []
    for key, entries in groups.items():
        rows_of = {e: [row for row, _ in found.values()] for e, found in entries.items()}
        usable = {e: rows for e, rows in rows_of.items() if any(r.start == Start.RECOVERY for r in rows)}
        if rows_of and not usable:
            refused.append((f"{key[0]}, {key[1]}", "no trials from recovery points"))
        for scenario_set, members in _sets(usable).items():
            try:
                board, trials = make_board(
                    key, scenario_set, {e: usable[e] for e in members}, logs, options, run_of, records
                )
            except RowsError as err:
                refused.append((f"{key[0]}, {key[1]}", str(err)))
                continue
            files = _files(folder, {e: entries[e].values() for e in members})
            boards.append((board, replace(trials, files=files)))
    boards.sort(key=lambda found: _order(found[0]))
    return Leaderboard(
        tuple(board for board, _ in boards),
        tuple(dict.fromkeys(refused)),
        tuple(trials for _, trials in boards),
    )


def _files(folder: Path, entries: Mapping[tuple, Iterable[tuple[TrialRow, str]]]) -> dict[str, Path]:
    """First log of every policy's trials from recovery points, where one entry alone has its name."""
    names = Counter(policy for policy, *_ in entries)
    return {
        policy: folder / next(name for row, name in found if row.start == Start.RECOVERY)
        for (policy, *_), found in entries.items()
        if names[policy] == 1
    }


def _order(board: Board) -> tuple:
    simulators = sorted(board.simulators.items())
    return board.platform, board.dataset, simulators, -len(board.entries), board.scenario_set


def _board_key(row: TrialRow) -> tuple:
    simulators = tuple(sorted((k, str(v)) for k, v in row.versions.items() if k != "lerobot"))
    revision = f"@{row.dataset_revision}" if row.dataset_revision else ""
    kind = "" if row.options.get("handoff_check", True) else ", handoff not checked"
    kind += ", approximate snapshots" if row.options.get("approximate_snapshots") else ""
    kind += f", {clock}" if (clock := clock_of(row)) else ""
    return row.platform, f"{row.dataset}{revision}", row.split, simulators, kind


def _entry_key(row: TrialRow, method: str) -> tuple:
    who = (method, None) if method else (row.policy, row.run_seed)
    settings = row.policy_settings or {}
    settings = settings_of_method(settings) if method else settings
    own = repr(sorted(row.options.items(), key=str)), repr(sorted(settings.items(), key=str))
    return *who, row.execution_horizon, *own


def _methods(folder: Path, files: Sequence[Path], methods: Sequence[str]) -> dict[Path, tuple[str, str]]:
    """Method and run of every log that belongs to one."""
    found: dict[Path, tuple[str, str]] = {}
    for text in methods:
        name, rest = split_named(text)
        if not name:
            raise RowsError(f"--method {text}: no name. Write METHOD=LOG,LOG")
        for part in rest.split(","):
            inside = [f for f in files if f == folder / part or (folder / part) in f.parents]
            if not inside:
                raise RowsError(f"--method {text}: {part}: no such log below {folder}")
            for file in inside:
                other = found.setdefault(file, (name, part))
                if other != (name, part):
                    raise RowsError(f"--method {text}: {file} is {other[1]} of {other[0]} already")
    return found


def _sets(entries: dict[tuple, list[TrialRow]]) -> dict[ScenarioHashes, list[tuple]]:
    """Entries by the scenario set of their board."""
    own: dict[ScenarioHashes, list[tuple]] = {}
    for entry, rows in entries.items():
        run = frozenset((r.scenario_id, r.scenario_sha256) for r in rows if r.start == Start.RECOVERY)
        own.setdefault(run, []).append(entry)
    boards: dict[ScenarioHashes, list[tuple]] = {}
    for run, members in own.items():
        wholes = [w for w in own if run < w and len(own[w]) >= len(members)]
        home = max(wholes, key=lambda w: (len(own[w]), len(w), sorted(w)), default=run)
        boards.setdefault(home, []).extend(members)
    # What took in a part may itself be part of another: its entries follow it.
    for home in sorted(boards, key=len):
        wholes = [w for w in boards if home < w and home not in own]
        if wholes:
            boards[max(wholes, key=len)] += boards.pop(home)
    return boards


def as_json(found: Leaderboard) -> dict[str, Any]:
    """The leaderboard for other programs; null is "not defined". The paper's rows are apart, as published."""
    from lerobot_roborecover.analysis.compare import without_nan

    return {
        "schema": LEADERBOARD_SCHEMA,
        "boards": [without_nan(asdict(board)) for board in found.boards],
        "published_not_rerun": [without_nan(asdict(row)) for row in published.policies()],
        "refused": [{"log": name, "reason": reason} for name, reason in found.refused],
    }
