"""A leaderboard from many trial logs: one board per set-up that may be compared, provenance in every row.

Logs on one board share platform, simulator versions and the scenario set, which is known by the hashes of its
scenarios' content: a log with one scenario more or another is of another set, and gets a board of its own. A
log of a part of a set is an incomplete entry of the board of that set, unless more policies were run on
exactly that part than on the whole. A log that cannot be read is listed with its reason; it never takes the
others down.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis import published
from lerobot_roborecover.analysis.first_states import with_first_states
from lerobot_roborecover.analysis.logs import clock_of
from lerobot_roborecover.analysis.named_path import split_named
from lerobot_roborecover.analysis.results import Options
from lerobot_roborecover.analysis.stats.arms import Arm, arm_of, stopped
from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import UNDEFINED, Estimate
from lerobot_roborecover.analysis.stats.labels import tell_settings_apart
from lerobot_roborecover.analysis.stats.macro import MacroCells, cells_of, macro_9_estimates, macro_estimates
from lerobot_roborecover.analysis.stats.panel import Panel, make_panel
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.runs import method_rate, run_rates
from lerobot_roborecover.analysis.stats.soundness import barred_arms
from lerobot_roborecover.analysis.stats.units import WORDS
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.logs.log_file import LOG_SUFFIXES
from lerobot_roborecover.logs.policy_settings import settings_of_method
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord, read_record
from lerobot_roborecover.logs.trial_log import ReadLog, TrialLogError, read_log
from lerobot_roborecover.scenario import Start

LEADERBOARD_SCHEMA = 1
_NAN = float("nan")


@dataclass(frozen=True)
class Provenance:
    """Where a row's numbers come from."""

    logs: tuple[str, ...]
    """File names with the first 12 digits of their SHA-256."""
    dataset: str
    dataset_revision: str | None
    versions: dict[str, str]
    run_seed: int | None
    execution_horizon: int | None
    options: dict[str, Any]
    config_hashes: tuple[str, ...]
    """Of the settings, one a start."""
    finished_at: str
    """Last trial, UTC."""


@dataclass(frozen=True)
class Entry:
    """One policy under one setting."""

    policy: str
    rsr: Estimate
    macro: Estimate
    """Over the board's cells that are large enough, see `Board.cells`."""
    macro9: Estimate
    """Over the paper's nine cells; undefined where the set or the entry lacks one."""
    initial: Estimate
    behind: Estimate
    """Best complete entry of the board minus this one, on common scenarios."""
    verdict: ComparisonVerdict | None
    """Of the best against this one, by Holm's p within the board; None for the best itself and for what is
    not ranked."""
    place: tuple[int, int] | None
    """Best and worst rank that the verdicts leave open; None for what is not ranked."""
    scenarios: int
    trials: int
    invalid: int
    interventions: bool
    """Whether anything but the policy acted; such rows are no entries of the policy comparison."""
    provenance: Provenance
    runs: int = 1
    """Runs of the method, where it has several."""
    other_runs: Estimate = UNDEFINED
    """RSR with the interval for other runs like these; undefined with one run."""
    run_sd: float = _NAN
    """SD between the runs' rates."""
    stopped: bool = False
    """Whether its run ended when a sequential comparison was decided; it has no rank."""
    missing: str = ""
    """What it lacks of what its runs were to evaluate, as far as the rows say."""


@dataclass(frozen=True)
class Board:
    """Entries that may be compared: complete ones by RSR, then those that lack scenarios."""

    platform: str
    dataset: str
    scenario_set: str
    """First 12 digits of the SHA-256 of its scenarios' ids and content hashes."""
    scenarios: int
    """In the set; an entry with fewer is incomplete."""
    simulators: dict[str, str]
    entries: tuple[Entry, ...]
    options: Options
    unit: str
    """What intervals and tests take as independent, in words."""
    cells: MacroCells
    """Which cells Macro averages, and which are too small."""


@dataclass(frozen=True)
class BoardTrials:
    """What a board's numbers were made from."""

    recovery: Panel
    initial: Panel | None
    """Trials of the same policies from initial states; None where there are none."""


@dataclass(frozen=True)
class Leaderboard:
    """All boards of a folder, and what could not be used."""

    boards: tuple[Board, ...]
    refused: tuple[tuple[str, str], ...]
    """File name and reason."""
    trials: tuple[BoardTrials, ...] = ()
    """Of each board."""


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
                boards.append(
                    _board(key, scenario_set, {e: usable[e] for e in members}, logs, options, run_of, records)
                )
            except RowsError as err:
                refused.append((f"{key[0]}, {key[1]}", str(err)))
    boards.sort(key=lambda found: _order(found[0]))
    return Leaderboard(
        tuple(board for board, _ in boards),
        tuple(dict.fromkeys(refused)),
        tuple(trials for _, trials in boards),
    )


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


type _Set = frozenset[tuple[str, str]]
"""Ids and content hashes of scenarios."""


def _sets(entries: dict[tuple, list[TrialRow]]) -> dict[_Set, list[tuple]]:
    """Entries by the scenario set of their board."""
    own: dict[_Set, list[tuple]] = {}
    for entry, rows in entries.items():
        run = frozenset((r.scenario_id, r.scenario_sha256) for r in rows if r.start == Start.RECOVERY)
        own.setdefault(run, []).append(entry)
    boards: dict[_Set, list[tuple]] = {}
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


def _board(
    key: tuple,
    scenario_set: _Set,
    usable: dict[tuple, list[TrialRow]],
    logs: dict,
    options: Options,
    run_of: dict[int, str],
    records: Sequence[SequentialRecord],
) -> tuple[Board, BoardTrials]:
    platform, dataset, split, simulators, kind = key
    arms = list(stopped([_arm(e, rows, Start.RECOVERY, run_of) for e, rows in usable.items()], records))
    panel = make_panel(arms, options.scheduled)
    unit = panel.unit(options.cluster)
    draws = resample(panel.units(unit), options.draws, options.seed, options.level)
    rsr, macro = draws.rates(panel.rates.T), macro_estimates(panel, draws)
    macro9 = macro_9_estimates(panel, draws)
    run = (panel.trials > 0).sum(1)
    acting = [any(r.interventions for r in arm.rows) for arm in arms]
    lacking = [a.missing.words if options.scheduled is None else a.missing.scenarios for a in arms]
    ranked = [
        p
        for p, arm in enumerate(arms)
        if run[p] == len(panel.scenarios) and not acting[p] and not arm.unreached and not lacking[p]
    ]
    methods = [method_rate(run_rates(a, panel, p, options.scheduled), draws) for p, a in enumerate(arms)]
    best = max(ranked, key=lambda p: rsr[p].value) if ranked else None
    behind = [_undefined()] * len(arms)
    if best is not None:
        behind = draws.differences((panel.rates[best] - panel.rates).T)
    found = contrasts(
        panel.rates, panel.arms, draws, list(combinations(ranked, 2)), unit=WORDS[unit],
        barred=barred_arms(panel),
    )  # fmt: skip
    between = dict(zip(combinations(ranked, 2), found, strict=True))
    entries = []
    for p, (e, rows) in enumerate(usable.items()):
        initial = [r for r in rows if r.start == Start.INITIAL]
        against = between.get((best, p)) or between.get((p, best)) if best is not None else None
        entries.append(
            Entry(
                policy=e[0],
                rsr=rsr[p],
                macro=macro[p],
                macro9=macro9[p],
                initial=_initial(_arm(e, initial, Start.INITIAL, run_of), options)
                if initial
                else _undefined(),
                behind=behind[p],
                verdict=None if against is None else _of_the_best(against, against is between.get((best, p))),
                place=_place(p, ranked, between) if p in ranked else None,
                scenarios=int(run[p]),
                trials=int(panel.trials[p].sum()),
                invalid=int(panel.invalid[p].sum()),
                interventions=acting[p],
                provenance=_provenance(rows, logs[key, e]),
                runs=len(methods[p].each),
                other_runs=methods[p].other_runs,
                run_sd=methods[p].sd,
                stopped=arms[p].unreached,
                missing=lacking[p],
            )
        )
    whole = len(panel.scenarios)
    entries.sort(
        key=lambda e: (e.interventions, e.scenarios < whole or bool(e.missing), -e.rsr.value, e.policy)
    )
    name = f"{dataset}, {split}{kind}"
    digest = hashlib.sha256("\n".join(f"{i} {h}" for i, h in sorted(scenario_set)).encode()).hexdigest()[:12]
    board = Board(
        platform, name, digest, len(panel.scenarios), dict(simulators), tuple(entries), options, WORDS[unit],
        cells_of(panel, draws),
    )  # fmt: skip
    before = [
        _arm(e, rows, Start.INITIAL, run_of)
        for e, rows in usable.items()
        if any(r.start == Start.INITIAL for r in rows)
    ]
    return board, BoardTrials(panel, make_panel(before) if before else None)


def _of_the_best(contrast: Contrast, best_is_a: bool) -> ComparisonVerdict:
    return contrast.verdict if best_is_a else contrast.reversed().verdict


def _place(p: int, ranked: list[int], between: dict[tuple[int, int], Contrast]) -> tuple[int, int]:
    """Ranks that are left open: below all that are better for certain, above all that are worse for
    certain."""
    above = below = 0
    for (a, b), contrast in between.items():
        if p in (a, b) and contrast.verdict.separated:
            ahead = (contrast.verdict is ComparisonVerdict.A_BETTER) == (p == a)
            above, below = above + (not ahead), below + ahead
    return 1 + above, len(ranked) - below


def _arm(entry: tuple, rows: Sequence[TrialRow], start: Start, run_of: dict[int, str]) -> Arm:
    runs: dict[str, list[TrialRow]] = {}
    for row in rows:
        if row.start == start:
            runs.setdefault(run_of[id(row)], []).append(row)
    return replace(arm_of(entry[0], start, runs), start=Start.RECOVERY, rewind_steps=(0,))


def _initial(arm: Arm, options: Options) -> Estimate:
    panel = make_panel([arm]).by_first_state()
    draws = resample(panel.units(options.cluster), options.draws, options.seed, options.level)
    return draws.rates(panel.rates.T)[0]


def _undefined() -> Estimate:
    return Estimate(_NAN, _NAN, _NAN)


def _provenance(rows: Sequence[TrialRow], logs: dict[str, None]) -> Provenance:
    first = rows[0]
    return Provenance(
        tuple(logs),
        first.dataset,
        first.dataset_revision,
        {k: str(v) for k, v in first.versions.items()},
        first.run_seed,
        first.execution_horizon,
        dict(first.options),
        tuple(sorted({r.config_hash for r in rows})),
        max(r.finished_at for r in rows),
    )


def as_json(found: Leaderboard) -> dict[str, Any]:
    """The leaderboard for other programs; null is "not defined". The paper's rows are apart, as published."""
    from lerobot_roborecover.analysis.compare import without_nan

    return {
        "schema": LEADERBOARD_SCHEMA,
        "boards": [without_nan(asdict(board)) for board in found.boards],
        "published_not_rerun": [without_nan(asdict(row)) for row in published.policies()],
        "refused": [{"log": name, "reason": reason} for name, reason in found.refused],
    }


def separated(entry: Entry) -> bool:
    """Whether the board's best is above this entry, by the verdict of the two."""
    return entry.verdict is not None and entry.verdict.separated


def ranks(board: Board) -> list[str]:
    """Rank of every entry: those that the verdicts leave open; none for incomplete ones and interventions."""
    texts = []
    for entry in board.entries:
        low, high = entry.place or (0, 0)
        texts.append("" if entry.place is None else str(low) if low == high else f"{low} to {high}")
    return texts
