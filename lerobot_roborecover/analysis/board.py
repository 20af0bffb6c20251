"""One board of a leaderboard: its entries, their places and where they come from."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.stats.arms import Arm, arm_of, stopped
from lerobot_roborecover.analysis.stats.contrasts import Contrast, contrasts
from lerobot_roborecover.analysis.stats.intervals import UNDEFINED, Estimate
from lerobot_roborecover.analysis.stats.macro import MacroCells, cells_of, macro_9_estimates, macro_estimates
from lerobot_roborecover.analysis.stats.panel import Panel, make_panel
from lerobot_roborecover.analysis.stats.resampling import resample
from lerobot_roborecover.analysis.stats.runs import method_rate, run_rates
from lerobot_roborecover.analysis.stats.soundness import barred_arms, valid_trials
from lerobot_roborecover.analysis.stats.units import WORDS
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord
from lerobot_roborecover.scenario import Start

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
    """Config hashes of the settings, one a start."""
    finished_at: str
    """Last trial, UTC."""


@dataclass(frozen=True)
class Entry:
    """One policy under one setting."""

    policy: str
    rsr: Estimate
    """Undefined where no trial was valid, as are `macro`, `macro9` and `behind`."""
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
    files: Mapping[str, Path] = field(default_factory=dict)
    """First log of every policy's trials from recovery points; none of a name that several entries have."""


type ScenarioHashes = frozenset[tuple[str, str]]
"""Ids and content hashes of scenarios."""


def make_board(
    key: tuple,
    scenario_set: ScenarioHashes,
    usable: dict[tuple, list[TrialRow]],
    logs: dict,
    options: Options,
    run_of: dict[int, str],
    records: Sequence[SequentialRecord],
) -> tuple[Board, BoardTrials]:
    """Ranks the policies of one scenario set.

    Args:
        key: platform, dataset, split, simulator versions and kind of the trials.
        scenario_set: ids and content hashes of its scenarios.
        usable: trials of each entry.
        logs: names and hashes of the log files, by board and entry.
        options: draws, seed, level, scheduled trials.
        run_of: names of the runs of methods, by the identity of a row.
        records: of sequential comparisons.
    """
    platform, dataset, split, simulators, kind = key
    arms = list(stopped([_arm(e, rows, Start.RECOVERY, run_of) for e, rows in usable.items()], records))
    panel = make_panel(arms, options.scheduled)
    unit = panel.unit(options.cluster)
    draws = resample(panel.units(unit), options.draws, options.seed, options.level)
    rsr, macro = draws.rates(panel.rates.T), macro_estimates(panel, draws)
    macro9 = macro_9_estimates(panel, draws)
    run = (panel.trials > 0).sum(1)
    acting = [arm.intervenes for arm in arms]
    lacking = [a.missing.words if options.scheduled is None else a.missing.scenarios for a in arms]
    valid = valid_trials(panel)
    ranked = [
        p
        for p, arm in enumerate(arms)
        if run[p] == len(panel.scenarios)
        and valid[p]
        and not acting[p]
        and not arm.unreached
        and not lacking[p]
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
                rsr=rsr[p] if valid[p] else UNDEFINED,
                macro=macro[p] if valid[p] else UNDEFINED,
                macro9=macro9[p] if valid[p] else UNDEFINED,
                initial=_initial(_arm(e, initial, Start.INITIAL, run_of), options)
                if initial
                else _undefined(),
                behind=behind[p] if valid[p] else UNDEFINED,
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
    entries.sort(key=lambda e: _order(e, whole))
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


def _order(entry: Entry, whole: int) -> tuple:
    """Complete policies first, by rate; those without one after them."""
    incomplete = entry.scenarios < whole or bool(entry.missing)
    rate = entry.rsr.value
    return entry.interventions, incomplete, math.isnan(rate), 0.0 if math.isnan(rate) else -rate, entry.policy


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
