"""Joins trial logs of shards: the same protocol, each trial once, and any disagreement an error that names
it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lerobot_roborecover.logs.extent import missing
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.sequential_record import record_path
from lerobot_roborecover.logs.trial_log import TrialLogError, read_log
from lerobot_roborecover.utils.atomic_io import atomic_file
from lerobot_roborecover.utils.outputs import OutputExistsError, check_new_file


def protocol_of(row: TrialRow) -> dict[str, object]:
    """What rows of one policy and one start must share to be one result."""
    return {
        "run seed": row.run_seed,
        # By the paper's rule it differs between scenarios, and the option `rewind_rule` says so.
        "rewind_steps": None if "rewind_rule" in row.options else row.rewind_steps,
        "execution horizon": row.execution_horizon,
        "dataset revision": row.dataset_revision,
        **{f"option {name}": value for name, value in sorted(row.options.items())},
        **{f"policy setting {name}": value for name, value in sorted((row.policy_settings or {}).items())},
        **{f"version of {name}": value for name, value in sorted(row.versions.items())},
    }


def check_same_protocol(rows: Sequence[TrialRow]) -> None:
    """Refuses rows that are not of one experiment.

    Raises:
        TrialLogError: naming the two scenarios, what differs, and both values.
    """
    first: dict[tuple[str, str], TrialRow] = {}
    contents: dict[str, TrialRow] = {}
    for row in rows:
        other = first.setdefault((row.policy, row.start), row)
        ours, theirs = protocol_of(row), protocol_of(other)
        for name in {**ours, **theirs}:
            if ours.get(name) != theirs.get(name):
                raise TrialLogError(
                    f"the logs are not of one protocol: {name} is {theirs.get(name)!r} for "
                    f"{other.scenario_id} "
                    f"and {ours.get(name)!r} for {row.scenario_id} (policy {row.policy}, start {row.start}). "
                    "Report them apart"
                )
        same = contents.setdefault(row.scenario_id, row)
        if (same.scenario_sha256, same.horizon) != (row.scenario_sha256, row.horizon):
            raise TrialLogError(
                f"two different scenarios are called {row.scenario_id} (content "
                f"{same.scenario_sha256[:12]}, horizon {same.horizon}, and {row.scenario_sha256[:12]}, "
                f"horizon {row.horizon}). Report them apart"
            )


def trial_counts(rows: Sequence[TrialRow]) -> dict[tuple[str, str], dict[int, int]]:
    """By policy and start: how many scenarios have how many trials."""
    trials: dict[tuple[str, str], dict[str, int]] = {}
    for row in rows:
        of = trials.setdefault((row.policy, row.start), {})
        of[row.scenario_id] = of.get(row.scenario_id, 0) + 1
    counts: dict[tuple[str, str], dict[int, int]] = {}
    for key, of in trials.items():
        for count in of.values():
            counts.setdefault(key, {})[count] = counts.setdefault(key, {}).get(count, 0) + 1
    return counts


def extent_remarks(rows: Sequence[TrialRow]) -> list[str]:
    """Returns what each policy's trials from each start lack of what their runs were to evaluate."""
    groups: dict[tuple[str, str], list[TrialRow]] = {}
    for row in rows:
        groups.setdefault((row.policy, row.start), []).append(row)
    lacking = {key: missing(group) for key, group in groups.items()}
    return [
        f"policy {policy}, start {start}: incomplete: {lack.words}. Run the rest, and merge again"
        for (policy, start), lack in lacking.items()
        if lack
    ]


@dataclass(frozen=True)
class Merged:
    """What came together."""

    rows: list[TrialRow]
    remarks: tuple[str, ...]
    """What was left out, and why; and what is missing."""


def merge(logs: Sequence[Path], out: Path, *, unequal: bool = False, force: bool = False) -> Merged:
    """Writes one log with the rows of many, ordered by scenario, start and trial.

    Args:
        logs: trial logs, of shards or of interrupted runs.
        out: the merged log.
        unequal: accept scenarios with different numbers of trials.
        force: replace a file that exists at `out`; a log that was merged, or is in use, is never replaced.

    Raises:
        TrialLogError: a log is damaged, the protocols differ, two rows disagree about one trial, or the trial
            counts are unequal.
        OutputExistsError, InUseError: `out` exists and is not replaced.
    """
    check_new_file(out, force=force, inputs=logs)
    if record_path(out).exists():
        raise OutputExistsError(
            f"{record_path(out)} says how another run was watched and would be read as the merged log's. "
            "Name another file, or move that record away"
        )
    found: dict[tuple, tuple[TrialRow, str]] = {}
    remarks: list[str] = []
    for path in logs:
        log = read_log(path)
        remarks += log.remarks
        if record_path(path).exists():
            remarks.append(
                f"{path}: its run was watched and may have stopped early, which {record_path(path).name} "
                "says and the merged log does not. Report the log itself"
            )
        for row, line in zip(log.rows, log.lines, strict=True):
            where = f"{path}, line {line}"
            other, before = found.setdefault(row.key(), (row, where))
            if (other.outcome, other.steps) != (row.outcome, row.steps):
                raise TrialLogError(
                    f"{where}: field 'outcome': trial {row.trial} of {row.scenario_id} ended as "
                    f"{row.outcome!r} after {row.steps} steps here and as {other.outcome!r} after "
                    f"{other.steps} in {before}. One of the two is wrong; keep the logs apart"
                )
    rows = [row for row, _ in found.values()]
    check_same_protocol(rows)
    for (policy, start), counts in trial_counts(rows).items():
        if len(counts) > 1 and not unequal:
            listed = ", ".join(f"{n} with {trials} trials" for trials, n in sorted(counts.items()))
            raise TrialLogError(
                f"policy {policy}, start {start}: scenarios differ in their number of trials "
                f"({listed}). A shard "
                "is unfinished or missing: run it with its own log, or accept it with --allow-unequal-trials"
                + "".join(f". {remark}" for remark in remarks)
            )
    remarks += extent_remarks(rows)
    rows.sort(key=lambda r: (r.scenario_id, r.start, r.policy, r.trial))
    with atomic_file(out) as path, open(path, "w", encoding="utf-8") as file:
        file.writelines(json.dumps(asdict(row), allow_nan=False) + "\n" for row in rows)
    return Merged(rows, tuple(remarks))
