"""From trial logs on disk to one study: rows that may be compared, arm by arm, and what to know about them.

Everything that would make a comparison wrong is refused here; what only limits it becomes a remark that the
report shows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

from lerobot_roborecover.analysis.first_states import screening_remark, with_first_states
from lerobot_roborecover.analysis.look_alikes import check_names
from lerobot_roborecover.analysis.named_path import missing, split_named, split_runs
from lerobot_roborecover.analysis.stats.arms import (
    Arm,
    arm_remarks,
    arms_of,
    check_runs,
    sequential_remarks,
    stopped,
)
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.fork_gain import FORK
from lerobot_roborecover.analysis.stats.labels import settings_differences, tell_settings_apart
from lerobot_roborecover.logs.fields import UNKNOWN_WEIGHTS
from lerobot_roborecover.logs.log_file import LOG_SUFFIXES
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import SequentialRecord, read_record
from lerobot_roborecover.logs.trial_log import ReadLog, TrialLogError, read_log
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
    files: Mapping[str, Path] = field(default_factory=dict)
    """First log of every arm, by its title."""

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
    runs: dict[str, dict[int, str]] = {}
    records: list[SequentialRecord] = []
    named = list(_files(logs))
    found, unknown = with_first_states([read_log(path, name or None) for name, _, path in named])
    for (name, run, path), log in zip(named, found, strict=True):
        if run is not None:
            runs.setdefault(name, {}).setdefault(run, _run_name(path))
        if (record := read_record(path)) is not None:
            records.append(record)
        remarks += log.remarks
        if name and len(log.policies) > 1:
            raise RowsError(
                f"{path} holds {len(log.policies)} policies ({', '.join(log.policies)}): no one NAME fits"
            )
        if name:
            _check_one_setting(log, name)
        if any(FORK in row.options for row in log.rows):
            raise RowsError(
                f"{path} holds forks of other trials, which say nothing of a policy at the recovery point: "
                "the page beside it says what they gain (roborecover detect fork)"
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
    remarks += unknown
    if twice:
        remarks.append(f"{twice} row(s) occur in more than one log with the same result; each counts once")
    check_names({row.policy for row in rows.values()})
    kept = [row for row in rows.values() if platform is None or row.platform == platform]
    del rows
    tell_settings_apart([row for row in kept if id(row) not in run_of])
    if not kept:
        where = ", ".join(str(log.path) for log in found)
        raise RowsError(f"no trial rows{f' of {platform}' if platform else ''} in {where}")
    _check_platform(kept)
    _check_scenarios(kept, found)
    _check_options(kept)
    remarks += _revisions(kept, found)
    remarks += screening_remark(found)
    remarks += _render_qualities(kept)
    remarks += _clocks(kept)
    remarks += _unknown_weights(kept)
    remarks += _check_versions(kept)
    check_runs(kept, runs, run_of)
    arms = stopped(arms_of(kept, runs, run_of), records)
    file_of: dict[tuple, Path] = {}
    for log in found:
        for key in {(row.policy, row.start, row.rewind_steps) for row in log.rows}:
            file_of.setdefault(key, log.path)
    files = {arm.title: file_of[arm.policy, arm.start, arm.rewind_steps[0]] for arm in arms}
    remarks += arm_remarks(arms) + sequential_remarks(arms, records)
    return Study(
        kept[0].platform, arms, tuple(remarks), tuple(log.path for log in found), tuple(records), files
    )


def _check_one_setting(log: ReadLog, name: str) -> None:
    """Refuses a log whose one NAME would hide that its policy had several settings."""
    known = [row for row in log.rows if row.policy_settings is not None]
    for row in known:
        if row.policy_settings != known[0].policy_settings:
            differences = settings_differences(known[0].policy_settings or {}, row.policy_settings or {})
            raise RowsError(
                f"{log.path} holds trials of {log.policies[0]} under several settings ({differences}): no "
                f"one NAME fits. Name the log alone, without {name}=, and they are distinguished"
            )


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
        first = [path / f"trials{suffix}" for suffix in LOG_SUFFIXES if (path / f"trials{suffix}").is_file()]
        inside = first[:1] or sorted(p for suffix in LOG_SUFFIXES for p in path.glob(f"*{suffix}"))
        if not inside:
            raise TrialLogError(
                f"no trial log in {path}: a folder must hold trials.jsonl or *.jsonl files, which may be "
                "compressed (.gz, .zst)"
            )
        return inside
    if not path.exists():
        raise TrialLogError(f"cannot read trial log {path}: {missing(text, path)}")
    return [path]


def _run_name(path: Path) -> str:
    """What a run is called: its log, or the folder of a log that is called like all of them."""
    name = path.name.partition(".jsonl")[0]
    return path.parent.name if name == "trials" and path.parent.name else name


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
        for name, one, other in zip(_FIXED_BY_SCENARIO, before, values, strict=True):
            if one != other:
                raise RowsError(
                    f"{_place(row, logs)}: field {name!r}: logs of different scenario sets: scenario "
                    f"{row.scenario_id} has {name} {one!r} for {first.policy} (dataset {first.dataset}) and "
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
    (`platforms.env_options.chosen_quality`)."""
    users: dict[str, str] = {}
    for row in _apart(rows, "options"):
        if row.options.get("obs_type") != "state":
            users.setdefault(str(row.options.get("render_quality", "full")), row.policy)
    users.pop("none", None)
    if len(users) < 2:
        return []
    text = ", ".join(f"{quality} ({policy})" for quality, policy in sorted(users.items()))
    return [f"the render quality differs between trials, and may move scores: {text}"]


def clock_of(row: TrialRow) -> str:
    """How a trial's time went on while its policy thought, in words; empty where it stood still."""
    during_inference = row.options.get("realtime")
    if not during_inference:
        return ""
    latency = row.options.get("latency_s")
    what = f"{latency:g} s an inference" if isinstance(latency, int | float) else "inferences as measured"
    return f"real time ({what}, {during_inference})"


def _unknown_weights(rows: Sequence[TrialRow]) -> list[str]:
    """A remark for each policy on a server that does not say which weights it has."""
    unknown = [
        r.policy for r in _apart(rows, "policy_settings") if UNKNOWN_WEIGHTS in (r.policy_settings or {})
    ]
    return [
        f"{policy}: the server's weights are not known, so its trials may be of several checkpoints"
        for policy in dict.fromkeys(unknown)
    ]


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
