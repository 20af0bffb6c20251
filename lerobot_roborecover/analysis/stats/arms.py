"""Arms of a study: the trials of one policy from one start, of one run or several, and what each lacks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.labels import settings_differences
from lerobot_roborecover.logs.extent import Missing, missing
from lerobot_roborecover.logs.fields import settings_of_method
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord
from lerobot_roborecover.scenario import Start


@dataclass(frozen=True)
class Arm:
    """All trials of one policy from one start under one setting."""

    policy: str
    """Its name in the report."""
    start: Start
    rewind_steps: tuple[int, ...]
    """Of its trials: one number, or those of the paper's rule, which asks the scenario's horizon."""
    rows: tuple[TrialRow, ...]
    """Rows of all its runs. Trials are numbered on from run to run."""
    runs: tuple[tuple[str, tuple[TrialRow, ...]], ...] = ()
    """Name and rows of every run, where the policy is a method of several; else empty."""
    unreached: bool = False
    """Whether scenarios are missing because a sequential test was decided before their turn: they are no
    failures, and the policy is not ranked."""
    missing: Missing = field(default_factory=Missing)
    """What it lacks of what its runs were to evaluate, as far as the rows say."""

    @property
    def intervenes(self) -> bool:
        """Whether its rows say that something intervened, or was there to do so."""
        return any(
            row.interventions or row.options.get("intervention", "direct") != "direct" for row in self.rows
        )

    @property
    def title(self) -> str:
        """Policy and, where it is not the recovery point, start."""
        if self.start is Start.REVERSION:
            return f"{self.policy}, {' or '.join(map(str, self.rewind_steps))} steps back"
        return self.policy if self.start is Start.RECOVERY else f"{self.policy}, initial state"


def check_runs(
    rows: Sequence[TrialRow], runs: Mapping[str, Mapping[int, str]], run_of: Mapping[int, int]
) -> None:
    """Refuses a run that is named twice: it would make a method look surer than it is."""
    ended: dict[tuple[str, int], set[tuple]] = {}
    for row in rows:
        if row.policy in runs:
            end = (*row.key(), row.outcome, row.steps, row.actions_sha256)
            ended.setdefault((row.policy, run_of.get(id(row), 0)), set()).add(end)
    for (name, first), (other, second) in combinations(ended, 2):
        if name == other and ended[name, first] & ended[name, second]:
            raise RowsError(
                f"{name}: {runs[name][first]} and {runs[name][second]} hold the same trials, with the same "
                "seed, actions and outcomes: they are one run. Name each run once"
            )


def arms_of(
    rows: Sequence[TrialRow], runs: Mapping[str, Mapping[int, str]], run_of: Mapping[int, int]
) -> tuple[Arm, ...]:
    """Rows by policy, start and rewind, in the order of the logs.

    Args:
        rows: of all logs.
        runs: names of the runs, by method and number.
        run_of: number of a row's run by the row's `id`; a row that is not there is of the first.

    Raises:
        RowsError: one run's rows were made under several settings, or a method's runs differ in more than
            weights and seed.
    """
    groups: dict[tuple, dict[int, list[TrialRow]]] = {}
    for row in rows:
        rewind = row.options.get("rewind_rule") or row.rewind_steps
        groups.setdefault((row.policy, row.start, rewind), {}).setdefault(run_of.get(id(row), 0), []).append(
            row
        )
    arms = []
    for (policy, start, _), by_run in groups.items():
        for group in by_run.values():
            settings: dict[str, TrialRow] = {}
            for row in group:
                settings.setdefault(row.config_hash, row)
            if len(settings) > 1:
                first, second = list(settings.values())[:2]
                raise RowsError(
                    f"{policy} has {start} trials under {len(settings)} settings, which differ in "
                    f"{_differences(first, second)}. Give each run a name (NAME=LOG), name the runs of one "
                    "method together (METHOD=LOG,LOG), or leave one out"
                )
        names = runs.get(policy, {})
        arms.append(arm_of(policy, Start(start), {names.get(k, policy): by_run[k] for k in sorted(by_run)}))
    return tuple(arms)


def arm_of(policy: str, start: Start, runs: Mapping[str, Sequence[TrialRow]]) -> Arm:
    """One arm of one run or several, whose trials are numbered on from run to run.

    Args:
        policy: its name.
        start: of all trials.
        runs: rows by the name of their run; at least one.

    Raises:
        RowsError: the runs differ in more than weights and seed.
    """
    firsts = [rows[0] for rows in runs.values()]
    lacking = [(run, missing(rows)) for run, rows in runs.items()]
    for first, run in zip(firsts, runs, strict=True):
        for what in ("execution_horizon", "options"):
            if getattr(first, what) != getattr(firsts[0], what):
                raise RowsError(
                    f"{policy}: its runs differ in {what}: {getattr(firsts[0], what)} in "
                    f"{next(iter(runs))}, {getattr(first, what)} in {run}. Runs of one method differ in "
                    "weights and seed alone; give them names of their own (NAME=LOG)"
                )
        ours, theirs = (settings_of_method(row.policy_settings or {}) for row in (firsts[0], first))
        recorded = first.policy_settings is not None and firsts[0].policy_settings is not None
        if ours != theirs and recorded:
            raise RowsError(
                f"{policy}: its runs differ in the policy's settings: {settings_differences(ours, theirs)} "
                f"({next(iter(runs))} / {run}). Runs of one method differ in weights and seed alone; give "
                "them names of their own (NAME=LOG)"
            )
    rewinds = tuple(sorted({row.rewind_steps for rows in runs.values() for row in rows}))
    if len(runs) == 1:
        (rows,) = runs.values()
        return Arm(policy, start, rewinds, tuple(rows), missing=lacking[0][1])
    stride = 1 + max(row.trial for rows in runs.values() for row in rows)
    numbered = tuple(
        (run, tuple(replace(row, trial=row.trial + k * stride) for row in rows))
        for k, (run, rows) in enumerate(runs.items())
    )
    of_runs = Missing(
        *("; ".join(f"{run}: {text}" for run, text in texts if text) for texts in (
            [(run, found.scenarios) for run, found in lacking],
            [(run, found.trials) for run, found in lacking],
        ))
    )  # fmt: skip
    rows = tuple(row for _, rows in numbered for row in rows)
    return Arm(policy, start, rewinds, rows, numbered, missing=of_runs)


def stopped(arms: Sequence[Arm], records: Sequence[SequentialRecord]) -> tuple[Arm, ...]:
    """The arms, those marked whose run ended when its sequential test was decided."""
    planned = {(r.config_hash, r.start): r for r in records}
    found = []
    for arm in arms:
        record = planned.get((arm.rows[0].config_hash, arm.start.value))
        if record is not None:
            trials = Counter(row.scenario_id for row in arm.rows)
            short = any(trials[scenario] < record.trials for scenario in record.scenarios)
            arm = replace(arm, unreached=record.decided and short)
            arm = replace(arm, missing=Missing()) if arm.unreached else arm
        found.append(arm)
    return tuple(found)


def _differences(first: TrialRow, second: TrialRow) -> str:
    fields = ("run_seed", "execution_horizon", "versions", "options")
    found = [
        f"{f} ({' / '.join(_apart(getattr(first, f), getattr(second, f)))})"
        for f in fields
        if getattr(first, f) != getattr(second, f)
    ]
    if first.policy_settings != second.policy_settings:
        differences = settings_differences(first.policy_settings or {}, second.policy_settings or {})
        found.append(f"the policy's settings ({differences})")
    return ", ".join(found) or "the evaluation's options (see the rows' config_hash)"


def _apart(one: object, other: object) -> tuple[str, str]:
    """Both values; of mappings what differs, alone."""
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return str(one), str(other)
    names = sorted(name for name in {*one, *other} if one.get(name) != other.get(name))
    told = [", ".join(f"{n} {of.get(n, 'not said')}" for n in names) for of in (one, other)]
    return told[0], told[1]


def sequential_remarks(arms: Sequence[Arm], records: Sequence[SequentialRecord]) -> list[str]:
    """Which arms were compared while they ran, and with which result."""
    remarks = []
    for record in records:
        for arm in arms:
            if (arm.rows[0].config_hash, arm.start.value) == (record.config_hash, record.start):
                more = (
                    "; it stopped there: scenarios after it are no failures, the policy is not ranked, and "
                    "only this pair has a verdict"
                    if arm.unreached
                    else ""
                )
                remarks.append(f"{arm.title}: its run was watched, and {record.words}{more}")
    return remarks


def arm_remarks(arms: Sequence[Arm]) -> list[str]:
    """What an arm lacks that another has: scenarios, runs of a scenario, trials."""
    remarks = []
    splits: Mapping[str, None] = dict.fromkeys(row.split for arm in arms for row in arm.rows)
    if len(splits) > 1:
        remarks.append(
            f"the trials are of several splits ({', '.join(splits)}); published scores are of test alone"
        )
    everywhere = {
        start: {row.scenario_id for arm in arms if arm.start is start for row in arm.rows} for start in Start
    }
    for arm in arms:
        if arm.missing:
            remarks.append(
                f"{arm.title}: incomplete: {arm.missing.words}; what is missing may be no accident, so it "
                "has no verdict. Run the rest, or ask for what all were run on with --shared-scenarios-only"
            )
        if arm.runs:
            run_on = [{row.scenario_id for row in rows} for _, rows in arm.runs]
            lacking_runs = set.union(*run_on) - set.intersection(*run_on)
            if lacking_runs:
                remarks.append(
                    f"{arm.title}: {len(lacking_runs)} of {len(set.union(*run_on))} scenarios lack one of "
                    f"its {len(run_on)} runs ({_some(lacking_runs)}) and do not count for it, unless "
                    "--trials says how many trials were scheduled"
                )
        trials: dict[str, set[int]] = {}
        for row in arm.rows:
            trials.setdefault(row.scenario_id, set()).add(row.trial)
        lacking = everywhere[arm.start] - set(trials)
        if lacking:
            remarks.append(
                f"{arm.title}: no trials on {len(lacking)} of {len(everywhere[arm.start])} "
                "scenarios that another "
                f"policy was run on ({_some(lacking)}); it is compared on the common ones only"
            )
        most = max(max(ks) for ks in trials.values()) + 1
        short = [s for s, ks in trials.items() if len(ks) < most]
        if short:
            remarks.append(
                f"{arm.title}: {len(short)} of {len(trials)} scenarios have fewer than {most} trials "
                f"({_some(short)}); each scenario's rate is over its own trials unless --trials "
                "says how many "
                "were scheduled"
            )
    return remarks


def _some(ids: Iterable[str], limit: int = 3) -> str:
    ids = sorted(ids)
    return ", ".join(ids[:limit]) + (", ..." if len(ids) > limit else "")
