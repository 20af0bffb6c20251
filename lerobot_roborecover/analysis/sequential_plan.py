"""What a comparison that is looked at while its logs grow was planned for: scenarios, units and trials.

The sequential test spends its error over the planned units, in an order that takes in units not yet run. A
plan made of the rows that happen to be there grows with them, and then errs far more often than it says. So
the plan comes from the rows' own `run_scenarios` and `run_trials` or from the scenario set, is fixed at the
first look, and is kept beside the log.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_roborecover.analysis.logs import Study
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.contrasts import Contrast
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.sequential import sequence
from lerobot_roborecover.analysis.stats.units import default_unit, unit_labels
from lerobot_roborecover.analysis.stats.verdicts import LEAST_DIFFERING
from lerobot_roborecover.datasets.load import load_scenarios
from lerobot_roborecover.logs.sequential_record import (
    SequentialRecord,
    read_record,
    record_path,
    write_record,
)


@dataclass(frozen=True)
class SequentialPlan:
    """The planned extent of one comparison."""

    units: Mapping[str, str]
    """Label of the independent unit of every planned scenario, by the scenario's id."""
    trials: tuple[int, int]
    """Planned trials per scenario of the two policies; 0 where any number is whole."""

    @property
    def members(self) -> dict[str, list[str]]:
        """Scenarios of every unit, sorted."""
        found: dict[str, list[str]] = {}
        for scenario in sorted(self.units):
            found.setdefault(self.units[scenario], []).append(scenario)
        return found


def planned_units(
    study: Study, scenarios: str, revision: str | None = None, select: str = ""
) -> dict[str, str]:
    """Units of a scenario set, by scenario id: what `--scenarios` names as planned.

    Args:
        study: its rows say which split they are of.
        scenarios: shipped name, folder or Hub id of the set.
        revision: on the Hub.
        select: expression of the runs' `--env.select`.
    """
    splits = {row.split for arm in study.arms for row in arm.rows}
    found = load_scenarios(
        scenarios, revision=revision, split=splits.pop() if len(splits) == 1 else None, select=select
    )
    ids = [s.id for s in found]
    labels = unit_labels(
        default_unit(study.platform),
        ids,
        [s.labels.cluster for s in found],
        [f"{s.task.suite}/{s.task.name}" for s in found],
    )
    return dict(zip(ids, labels.tolist(), strict=True))


def plan_of(
    panel: Panel,
    pair: tuple[int, int],
    arms: Sequence[Arm],
    planned: Mapping[str, str] | None = None,
    scheduled: int | None = None,
) -> SequentialPlan:
    """The plan of two policies' comparison.

    Args:
        panel: their trials.
        pair: indices of arms.
        arms: of the panel, in its order.
        planned: units by scenario id, where `--scenarios` names them.
        scheduled: trials per scenario, where `--trials` names them.

    Raises:
        RowsError: the rows do not say what their runs were to evaluate, or hold more or other than that.
    """
    two = [arms[p] for p in pair]
    run = np.any(panel.trials[list(pair)] > 0, axis=0)
    there = [s.id for n, s in enumerate(panel.scenarios) if run[n]]
    counts = {row.run_scenarios for arm in two for row in arm.rows}
    if planned is not None:
        units = planned
        other = sorted(set(there) - set(planned))
        if other:
            raise RowsError(
                f"--scenarios: the logs have {len(other)} scenarios that the named set lacks ({other[0]}, "
                "...). Name the set, --revision and --select that the runs had"
            )
        if counts - {None, len(planned)}:
            raise RowsError(
                f"--scenarios: the named set has {len(planned)} scenarios, and the runs were to evaluate "
                f"{_numbers(counts)}. Name the set and --select that the runs had"
            )
    else:
        units = dict(zip(there, panel.units()[run].tolist(), strict=True))
        remedy = f"Name the set: --scenarios {two[0].rows[0].dataset} (with --select, where the runs had it)"
        if None in counts:
            raise RowsError(
                "--sequential needs the planned scenarios, and the logs, of an earlier version, do not say "
                f"how many they were. {remedy}"
            )
        if len(counts) > 1:
            raise RowsError(
                f"--sequential: the runs were to evaluate {_numbers(counts)} scenarios, which is no one "
                "plan. Evaluate both policies on one --env.select"
            )
        (count,) = counts
        if count != len(there):
            raise RowsError(
                f"--sequential needs the planned scenarios: the runs were to evaluate {count}, and the logs "
                f"name {len(there)} so far. {remedy}"
            )
    trials = (_trials(two[0], scheduled), _trials(two[1], scheduled))
    for p, most in zip(pair, trials, strict=True):
        worst = int(panel.trials[p].argmax())
        if panel.trials[p, worst] > most:
            raise RowsError(
                f"--sequential: {panel.arms[p]} has {panel.trials[p, worst]} trials of "
                f"{panel.scenarios[worst].id}, and {most} were planned. More trials of a scenario that has "
                "counted would change a look that is past: leave them out"
            )
    return SequentialPlan(units, trials)


def _numbers(counts: set[int | None]) -> str:
    return " and ".join(str(c) for c in sorted(c for c in counts if c is not None))


def _trials(arm: Arm, scheduled: int | None) -> int:
    """Planned trials per scenario, over all runs of a method."""
    told = {row.run_trials for row in arm.rows} if scheduled is None else {scheduled}
    if len(told) > 1 or None in told:
        raise RowsError(
            f"--sequential needs the planned trials per scenario, and the rows of {arm.title} "
            + (f"say {_numbers(told)}" if told - {None} else "do not say them")
            + ". Say them: --trials K"
        )
    (count,) = told
    return int(count or 0) * max(1, len(arm.runs))


def recorded_plan(record: SequentialRecord, panel: Panel) -> SequentialPlan:
    labels = record.units or [
        dict(zip([s.id for s in panel.scenarios], panel.units().tolist(), strict=True)).get(
            scenario, f"scenario:{scenario}"
        )
        for scenario in record.scenarios
    ]
    units = dict(zip(record.scenarios, labels, strict=True))
    return SequentialPlan(units, (record.trials, record.against_trials))


def check_plan(record: SequentialRecord, planned: Mapping[str, str] | None) -> None:
    """Refuses another plan than that of the first look.

    Raises:
        RowsError: `--scenarios` names another set.
    """
    if planned is not None and set(planned) != set(record.scenarios):
        raise RowsError(
            f"--scenarios names {len(planned)} scenarios, and the first look at {record.policy} against "
            f"{record.against} planned {len(record.scenarios)}: the plan is fixed at the first look. Name "
            "the same set, or leave --scenarios out"
        )


def keep_plan(
    study: Study, arms: tuple[Arm, Arm], plan: SequentialPlan, contrast: Contrast, level: float
) -> Path:
    """Writes plan and result beside the log of one of the two policies; returns the file.

    Args:
        study: says where the logs are.
        arms: of the contrast's two policies, in its order.
        plan: of the comparison, the first policy's trials first.
        contrast: what it says now.
        level: planned level.

    Raises:
        RowsError: both logs have the record of another comparison.
    """
    order = [s for unit in sequence(plan.members) for s in plan.members[unit]]
    places = [(arms, plan.trials, 1), (arms[::-1], plan.trials[::-1], -1)]
    before = [read_record(study.files[own.policy]) for (own, _), _, _ in places]
    same = [r is not None and _hashes(own, other) == (r.config_hash, r.against_config_hash)
            for ((own, other), _, _), r in zip(places, before, strict=True)]  # fmt: skip
    free = [k for k in sorted(range(2), key=lambda k: not same[k]) if same[k] or before[k] is None]
    if not free:
        raise RowsError(
            f"--sequential: {record_path(study.files[arms[0].policy])} and "
            f"{record_path(study.files[arms[1].policy])} keep the plans of other comparisons. Compare copies "
            "of the logs in folders of their own"
        )
    (own, other), trials, sign = places[free[0]]
    decided = contrast.p < 1 - level and contrast.differing >= LEAST_DIFFERING
    which = "better" if sign * contrast.difference.value > 0 else "worse"
    where = f"{contrast.scenarios} of {len(order)} scenarios"
    rival = study.files[other.policy]
    mine, others = _hashes(own, other)
    return write_record(
        study.files[own.policy],
        SequentialRecord(
            policy=own.rows[0].policy,
            config_hash=mine,
            start=own.start.value,
            trials=trials[0],
            scenarios=tuple(order),
            level=level,
            against=other.rows[0].policy,
            against_config_hash=others,
            against_log=rival.name,
            against_sha256=hashlib.sha256(rival.read_bytes()).hexdigest(),
            decided=decided,
            after_scenarios=contrast.scenarios,
            p=None if math.isnan(contrast.p) else contrast.p,
            words=f"decided after {where}: {which} than {other.policy}"
            if decided
            else f"not decided against {other.policy} on {where}",
            units=tuple(plan.units[s] for s in order),
            against_trials=trials[1],
        ),
    )


def _hashes(own: Arm, other: Arm) -> tuple[str, str]:
    return own.rows[0].config_hash, other.rows[0].config_hash
