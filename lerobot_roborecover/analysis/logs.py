"""From trial logs on disk to one study: rows that may be compared, arm by arm, and what to know about them.

Everything that would make a comparison wrong is refused here; what only limits it becomes a remark that the
report shows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from operator import attrgetter
from pathlib import Path

from lerobot_roborecover.analysis.estimators import RowsError
from lerobot_roborecover.analysis.fork_gain import FORK
from lerobot_roborecover.analysis.named_path import missing, split_named, split_runs
from lerobot_roborecover.analysis.sequential_record import SequentialRecord, read_record
from lerobot_roborecover.env.trial_log import ReadLog, TrialLogError, TrialRow, read_log
from lerobot_roborecover.scenario import Start

_FIXED_BY_SCENARIO = (
    "scenario_sha256",
    "platform",
    "suite",
    "task",
    "instruction",
    "horizon",
    "stage",
    "deviation",
    "source",
    "source_policy",
    "cluster",
)
"""Fields that a scenario id decides: rows that disagree about one are of different scenario sets."""
_TOLERATED_VERSIONS = ("lerobot",)
"""Packages whose version may differ between logs, with a remark: they do not move the simulated world."""


@dataclass(frozen=True)
class Arm:
    """All trials of one policy from one start under one setting."""

    policy: str
    """Its name in the report."""
    start: Start
    rewind_steps: tuple[int, ...]
    """Of its trials: one number, or those of the paper's rule, which asks the scenario's horizon."""
    rows: tuple[TrialRow, ...]
    """Of all its runs. Trials are numbered on from run to run."""
    runs: tuple[tuple[str, tuple[TrialRow, ...]], ...] = ()
    """Name and rows of every run, where the policy is a method of several; else empty."""
    unreached: bool = False
    """Whether scenarios are missing because a sequential test was decided before their turn: they are no
    failures, and the policy is not ranked."""

    @property
    def title(self) -> str:
        """Policy and, where it is not the recovery point, start."""
        if self.start is Start.REVERSION:
            return f"{self.policy}, {' or '.join(map(str, self.rewind_steps))} steps back"
        return self.policy if self.start is Start.RECOVERY else f"{self.policy}, initial state"


@dataclass(frozen=True)
class Study:
    """Logs that belong together: one platform, one scenario set, one version of the world."""

    platform: str
    arms: tuple[Arm, ...]
    """In the order of the logs."""
    remarks: tuple[str, ...]
    """What a reader of the numbers has to know."""
    logs: tuple[Path, ...]
    sequential: tuple[SequentialRecord, ...] = ()
    """Runs of these logs that were watched while they went."""

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of the policies, each once."""
        return tuple(dict.fromkeys(arm.policy for arm in self.arms))

    def of(self, start: Start) -> tuple[Arm, ...]:
        """Arms with that start; at most one a policy, except for reversion."""
        return tuple(arm for arm in self.arms if arm.start is start)


def read_study(logs: Sequence[str], platform: str | None = None) -> Study:
    """Reads logs and checks that their trials may be compared.

    Args:
        logs: `LOG` or `NAME=LOG`; LOG is a file, or a folder that holds `trials.jsonl` or other `.jsonl`
            files. NAME replaces the policy's own name, and keeps two runs of one policy apart.
            `METHOD=LOG,LOG,...` takes several runs of one method together, a LOG each.
        platform: keep only this platform's rows.

    Raises:
        TrialLogError: a log cannot be read.
        RowsError: the logs do not belong together; the message says which and why.
    """
    remarks: list[str] = []
    rows: dict[tuple, TrialRow] = {}
    run_of: dict[int, int] = {}
    """By the identity of a row; of rows that are of no run, or of the first, nothing is said."""
    twice = 0
    found: list[ReadLog] = []
    runs: dict[str, dict[int, str]] = {}
    records: list[SequentialRecord] = []
    for name, run, path in _files(logs):
        log = read_log(path, name or None)
        found.append(log)
        if run is not None:
            runs.setdefault(name, {}).setdefault(run, _run_name(path))
        if (record := read_record(path)) is not None:
            records.append(record)
        remarks += log.remarks
        if name and len(log.policies) > 1:
            raise RowsError(
                f"{path} holds {len(log.policies)} policies ({', '.join(log.policies)}): no one NAME fits"
            )
        if any(FORK in row.options for row in log.rows):
            raise RowsError(
                f"{path} holds forks of other trials, which say nothing of a policy at the recovery point: "
                "the page beside it says what they gain (roborecover fork)"
            )
        for row in log.rows:
            other = rows.setdefault((row.policy, run or 0, *row.key()), row)
            if other is row:
                if run:
                    run_of[id(row)] = run
                continue
            twice += 1
            if (other.outcome, other.steps) != (row.outcome, row.steps):
                raise RowsError(
                    f"{_place(row, found)}: field 'outcome': trial {row.trial} of {row.scenario_id} by "
                    f"{row.policy} ended as {row.outcome!r} after {row.steps} steps, and as "
                    f"{other.outcome!r} after {other.steps} in {_place(other, found)}. "
                    "Give the runs names (NAME=LOG), or leave one out"
                )
    if twice:
        remarks.append(f"{twice} row(s) occur in more than one log with the same result; each counts once")
    kept = [row for row in rows.values() if platform is None or row.platform == platform]
    del rows
    if not kept:
        where = ", ".join(str(log.path) for log in found)
        raise RowsError(f"no trial rows{f' of {platform}' if platform else ''} in {where}")
    _check_platform(kept)
    _check_scenarios(kept, found)
    _check_options(kept)
    remarks += _revisions(kept, found)
    remarks += _render_qualities(kept)
    remarks += _clocks(kept)
    remarks += _check_versions(kept)
    _check_runs(kept, runs, run_of)
    arms = stopped(_arms(kept, runs, run_of), records)
    remarks += _remarks(arms) + _sequential_remarks(arms, records)
    return Study(kept[0].platform, arms, tuple(remarks), tuple(log.path for log in found), tuple(records))


def _place(row: TrialRow, logs: Sequence[ReadLog]) -> str:
    """File and line of a row, looked for only where an error or a remark has to name them."""
    for log in logs:
        for line, candidate in zip(log.lines, log.rows, strict=True):
            if candidate is row:
                return f"{log.path}, line {line}"
    raise ValueError("the row is of none of these logs")


def _files(logs: Sequence[str]) -> Iterable[tuple[str, int | None, Path]]:
    """Name, run and file of every log; the run is None where the name has but one."""
    for text in logs:
        name, rest = split_named(text)
        parts = split_runs(rest)
        if len(parts) > 1 and not name:
            raise RowsError(f"{text!r}: several runs take the name of their method: METHOD={text}")
        for run, part in enumerate(parts):
            for path in _in_folder(Path(part), text):
                yield name, run if len(parts) > 1 else None, path


def _in_folder(path: Path, text: str) -> Iterable[Path]:
    if path.is_dir():
        inside = (
            [path / "trials.jsonl"] if (path / "trials.jsonl").is_file() else sorted(path.glob("*.jsonl"))
        )
        if not inside:
            raise TrialLogError(f"no trial log in {path}: a folder must hold trials.jsonl or *.jsonl files")
        return inside
    if not path.exists():
        raise TrialLogError(f"cannot read trial log {path}: {missing(text, path)}")
    return [path]


def _run_name(path: Path) -> str:
    """What a run is called: its log, or the folder of a log that is called like all of them."""
    return path.parent.name if path.name == "trials.jsonl" and path.parent.name else path.stem


def _check_platform(rows: Sequence[TrialRow]) -> None:
    platforms = sorted({row.platform for row in rows})
    if len(platforms) > 1:
        raise RowsError(
            f"the logs are of {len(platforms)} platforms ({', '.join(platforms)}), whose rates "
            "cannot be averaged. "
            f"Take one at a time: --platform {platforms[0]}"
        )


def _check_scenarios(rows: Sequence[TrialRow], logs: Sequence[ReadLog]) -> None:
    known: dict[str, tuple[tuple, TrialRow]] = {}
    for row in rows:
        values = _fixed(row)
        before, first = known.setdefault(row.scenario_id, (values, row))
        if before == values:
            continue
        for field, one, other in zip(_FIXED_BY_SCENARIO, before, values, strict=True):
            if one != other:
                raise RowsError(
                    f"{_place(row, logs)}: field {field!r}: logs of different scenario sets: scenario "
                    f"{row.scenario_id} has {field} {one!r} for {first.policy} (dataset {first.dataset}) and "
                    f"{other!r} for {row.policy} (dataset {row.dataset}). Evaluate both on one set"
                )


_fixed = attrgetter(*_FIXED_BY_SCENARIO)


def _revisions(rows: Sequence[TrialRow], logs: Sequence[ReadLog]) -> list[str]:
    """A remark where trials name several sources of their scenarios.

    Their content is the same, or the rows would have been refused; a reader who wants to run them again has
    to know.
    """
    users: dict[tuple[str, str], TrialRow] = {}
    for row in rows:
        users.setdefault((row.dataset, row.dataset_revision or ""), row)
    if len(users) < 2:
        return []
    text = "; ".join(
        f"{dataset}{f' at {revision}' if revision else ''} ({_place(row, logs)})"
        for (dataset, revision), row in sorted(users.items())
    )
    return [
        "the scenarios have the same content in all logs, but the fields 'dataset' and 'dataset_revision' "
        f"differ: {text}. Evaluate all policies with one --env.scenarios and --env.revision"
    ]


def _apart(rows: Sequence[TrialRow], field: str) -> list[TrialRow]:
    """The first row of every policy with every object of that field: rows of a log share them."""
    found: dict[tuple[str, int], TrialRow] = {}
    for row in rows:
        found.setdefault((row.policy, id(getattr(row, field))), row)
    return list(found.values())


def _check_options(rows: Sequence[TrialRow]) -> None:
    rows = _apart(rows, "options")
    users: dict[bool, str] = {}
    for row in rows:
        users.setdefault(bool(row.options.get("handoff_check", True)), row.policy)
    if len(users) > 1:
        raise RowsError(
            f"logs of different protocols: the handoff was checked for {users[True]} and not for "
            f"{users[False]}. "
            "Evaluate all policies with --env.handoff_check=true"
        )
    starts: dict[bool, str] = {}
    for row in rows:
        starts.setdefault(bool(row.options.get("approximate_snapshots")), row.policy)
    if len(starts) > 1:
        raise RowsError(
            f"logs of different protocols: trials of {starts[True]} started from approximate snapshots, and "
            f"those of {starts[False]} from exact replays. Evaluate all policies without "
            "--env.approximate_snapshots"
        )


def _render_qualities(rows: Sequence[TrialRow]) -> list[str]:
    """A remark where policies saw pictures of different quality; a row that says none has LeRobot's own
    (`platforms.base.chosen_quality`)."""
    users: dict[str, str] = {}
    for row in _apart(rows, "options"):
        users.setdefault(str(row.options.get("render_quality", "full")), row.policy)
    users.pop("none", None)
    if len(users) < 2:
        return []
    text = ", ".join(f"{quality} ({policy})" for quality, policy in sorted(users.items()))
    return [f"the render quality differs between trials, and may move scores: {text}"]


def clock_of(row: TrialRow) -> str:
    """How a trial's time went on while its policy thought, in words; empty where it stood still."""
    meanwhile = row.options.get("realtime")
    if not meanwhile:
        return ""
    latency = row.options.get("latency_s")
    what = f"{latency:g} s an inference" if isinstance(latency, int | float) else "inferences as measured"
    return f"real time ({what}, {meanwhile})"


def _clocks(rows: Sequence[TrialRow]) -> list[str]:
    """A remark where time stood still for some policies only, or went on otherwise."""
    users: dict[str, str] = {}
    for row in _apart(rows, "options"):
        users.setdefault(clock_of(row) or "frozen clock", row.policy)
    if len(users) < 2:
        return []
    text = "; ".join(f"{clock} ({policy})" for clock, policy in sorted(users.items()))
    return [f"time did not go on alike while policies thought: {text}"]


def _check_versions(rows: Sequence[TrialRow]) -> list[str]:
    remarks = []
    rows = _apart(rows, "versions")
    for name in sorted({name for row in rows for name in row.versions}):
        users: dict[str, str] = {}
        for row in rows:
            users.setdefault(str(row.versions.get(name, "unknown")), row.policy)
        if len(users) < 2:
            continue
        text = ", ".join(f"{version} ({policy})" for version, policy in sorted(users.items()))
        if name not in _TOLERATED_VERSIONS:
            raise RowsError(
                f"logs of different protocols: {name} differs: {text}. Simulator versions change scores; "
                "evaluate all policies with the same"
            )
        remarks.append(f"{name} differs between trials: {text}")
    return remarks


def _arms(
    rows: Sequence[TrialRow], runs: Mapping[str, Mapping[int, str]], run_of: Mapping[int, int]
) -> tuple[Arm, ...]:
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


def _check_runs(
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
    for first, run in zip(firsts, runs, strict=True):
        for field in ("execution_horizon", "options"):
            if getattr(first, field) != getattr(firsts[0], field):
                raise RowsError(
                    f"{policy}: its runs differ in {field}: {getattr(firsts[0], field)} in "
                    f"{next(iter(runs))}, {getattr(first, field)} in {run}. Runs of one method differ in "
                    "weights and seed alone; give them names of their own (NAME=LOG)"
                )
    rewinds = tuple(sorted({row.rewind_steps for rows in runs.values() for row in rows}))
    if len(runs) == 1:
        (rows,) = runs.values()
        return Arm(policy, start, rewinds, tuple(rows))
    stride = 1 + max(row.trial for rows in runs.values() for row in rows)
    numbered = tuple(
        (run, tuple(replace(row, trial=row.trial + k * stride) for row in rows))
        for k, (run, rows) in enumerate(runs.items())
    )
    return Arm(policy, start, rewinds, tuple(row for _, rows in numbered for row in rows), numbered)


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
        found.append(arm)
    return tuple(found)


def _sequential_remarks(arms: Sequence[Arm], records: Sequence[SequentialRecord]) -> list[str]:
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


def _differences(first: TrialRow, second: TrialRow) -> str:
    fields = ("run_seed", "execution_horizon", "versions", "options")
    found = [
        f"{f} ({getattr(first, f)} / {getattr(second, f)})"
        for f in fields
        if getattr(first, f) != getattr(second, f)
    ]
    return ", ".join(found) or "the evaluation's options (see the rows' config_hash)"


def _remarks(arms: Sequence[Arm]) -> list[str]:
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
