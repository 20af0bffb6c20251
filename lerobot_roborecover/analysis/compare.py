"""Two policies on one screen: difference, interval, adjusted p, its cells, and a verdict in words."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.logs import Study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.sequential_plan import keep_plan, recorded_plan
from lerobot_roborecover.analysis.stats.contrasts import Contrast, Share, contributions
from lerobot_roborecover.analysis.stats.crossfit import Profile, profile_difference
from lerobot_roborecover.analysis.stats.estimators import UNDERPOWERED_BELOW, RowsError
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.runs import MethodContrast, MethodRate
from lerobot_roborecover.analysis.stats.units import ESTIMAND, ResamplingUnit
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict, method_text, verdict_text
from lerobot_roborecover.analysis.tables import NOT_DEFINED, Column, Table, cell_text, to_text
from lerobot_roborecover.scenario import Start

_BAR_WIDTH = 41


@dataclass(frozen=True)
class Comparison:
    """A against B, on the scenarios that both were run on; rates in [0, 1]."""

    a: str
    b: str
    scenarios: int
    trials: tuple[int, int]
    invalid: tuple[int, int]
    rsr: tuple[Estimate, Estimate]
    contrast: Contrast
    """A minus B, with p adjusted for the family of the question."""
    decision: ComparisonVerdict
    """What may be said of the two."""
    tasks: Estimate | None
    """The difference with its interval for other tasks like these; None where tasks are resampled anyhow."""
    initial: Contrast | None
    """The same from initial states, where both have such trials."""
    profile: Profile
    """How differently the two do, scenario by scenario."""
    cells: tuple[Share, ...]
    methods: tuple[MethodRate, MethodRate] | None
    """The two as methods of several runs; None where each has one run."""
    of_methods: MethodContrast | None
    """What may be said of the methods; None where each has one run, or one is an intervention."""
    verdict: str
    """The decision in words."""
    resampling: dict[str, Any]
    remarks: tuple[str, ...]


def compare(
    study: Study, a: str | None = None, b: str | None = None, options: Options | None = None
) -> Comparison:
    """Compares two policies of a study, or an intervention with its direct control.

    Args:
        study: their trials, and maybe others'.
        a: title of the first; by default the first of the only two.
        b: title of the second.
        options: draws, seed, level, scheduled trials, and the like.

    Raises:
        RowsError: it is not clear which two, they are no one question, or they have no scenario in common.
    """
    results = analyse(study, options)
    options = results.options
    policies = results.recovery.arms
    acting = () if results.interventions is None else results.interventions.arms
    named = [arm.title for arm in study.arms]  # A is whose log was named first, not who is better
    first, second = _choose(tuple(sorted({*policies, *acting}, key=named.index)), a, b)
    contrast = results.contrast(first, second)
    if options.sequential and not contrast.scenarios:
        raise RowsError(
            f"--sequential: no scenario's turn has come in {first} and {second}. It counts scenarios in the "
            "order in which roborecover eval --sequential runs them"
        )
    if contrast.sequential and options.sequential:
        _keep_plan(results, contrast)
    if not contrast.scenarios:
        raise RowsError(f"{first} and {second} were run on different scenarios: there is none in common")
    panel = _pair_panel(results, first, second)
    draws = results.resample(panel)
    rsr = draws.rates(panel.rates.T)
    everyone = len((results.recovery if first in policies and second in policies else panel).scenarios)
    remarks = [
        r
        for r in results.remarks
        if r != results.compared.words
        and (first in r or second in r or not any(arm in r for arm in policies))
    ]
    if contrast.scenarios < everyone:
        remarks.append(
            f"only {contrast.scenarios} of {everyone} scenarios, which both were run on, are compared"
        )
    if first not in policies or second not in policies:
        remarks.append("one of the two is an intervention: this measures the intervention, not a policy")
    methods = _methods(results, first, second)
    return Comparison(
        first,
        second,
        contrast.scenarios,
        (int(panel.trials[0].sum()), int(panel.trials[1].sum())),
        (int(panel.invalid[0].sum()), int(panel.invalid[1].sum())),
        (rsr[0], rsr[1]),
        contrast,
        contrast.verdict,
        _tasks(results, panel),
        _initial(results, first, second),
        profile_difference(panel, 0, 1, draws),
        tuple(contributions(panel.rates[0], panel.rates[1], panel.labels("cell"))),
        None if methods is None else methods[0],
        None if methods is None else methods[1],
        verdict_text(contrast),
        {
            "unit": results.unit,
            "units": draws.units,
            "estimand": ESTIMAND[panel.unit(options.cluster)],
            "level": options.level,
        },
        tuple(dict.fromkeys(remarks)),
    )


def _keep_plan(results: Results, contrast: Contrast) -> None:
    """Keeps the plan of the first look beside a log, unless a run of `eval --sequential` keeps one there."""
    names, study = results.recovery.arms, results.study
    pair = names.index(contrast.a), names.index(contrast.b)
    if not study.files:
        return
    arms = {arm.title: arm for arm in study.of(Start.RECOVERY)}
    two, record = (arms[contrast.a], arms[contrast.b]), results.record_of(contrast.a, contrast.b)
    if record is None:
        keep_plan(study, two, results.sequential_plan(pair), contrast, results.options.level)
    elif record.against_trials:
        plan = recorded_plan(record, results.recovery)
        if record.config_hash != two[0].rows[0].config_hash:
            plan = replace(plan, trials=plan.trials[::-1])
        keep_plan(study, two, plan, contrast, record.level)


def _choose(titles: Sequence[str], a: str | None, b: str | None) -> tuple[str, str]:
    there = ", ".join(titles) or "none"
    for name in (a, b):
        if name is not None and name not in titles:
            raise RowsError(
                f"no policy {name!r} with trials from recovery points in the logs; there are: {there}"
            )
    if a is None and b is None and len(titles) == 2:
        return titles[0], titles[1]
    if a is None or b is None:
        if len(titles) < 2:
            raise RowsError(
                f"a comparison takes two policies with trials from recovery points; the logs have: {there}. "
                "Two runs of one policy need names: NAME=LOG"
            )
        raise RowsError(f"say which two with --a and --b; there are: {there}")
    if a == b:
        raise RowsError(f"--a and --b are both {a!r}")
    return a, b


def _pair_panel(results: Results, a: str, b: str) -> Panel:
    """The two on the scenarios that their contrast is over."""
    whole = results.recovery
    if not {a, b} <= set(whole.arms):
        whole = results.interventions or whole
    elif {a, b} <= set(results.ranked.arms):
        whole = results.ranked
    both = [whole.arm(a), whole.arm(b)]
    common = np.flatnonzero(np.isfinite(whole.rates[both]).all(0))
    return whole.take(both, common.tolist())


def _tasks(results: Results, panel: Panel) -> Estimate | None:
    """The difference with its interval for other tasks; None where tasks are the units anyhow."""
    if panel.unit(results.options.cluster) is ResamplingUnit.TASK:
        return None
    return results.resample(panel, ResamplingUnit.TASK).differences(
        (panel.rates[0] - panel.rates[1])[:, None]
    )[0]


def _methods(results: Results, a: str, b: str) -> tuple[tuple[MethodRate, MethodRate], MethodContrast] | None:
    """The two as methods of several runs; None where neither has several, or one is an intervention."""
    names = results.recovery.arms
    if not {a, b} <= set(names):
        return None
    both = results.method_rates[names.index(a)], results.method_rates[names.index(b)]
    if all(len(m.each) == 1 for m in both):
        return None
    for c in results.method_contrasts:
        if {c.these_runs.a, c.these_runs.b} == {a, b}:
            return both, c if c.these_runs.a == a else c.reversed()
    raise AssertionError("every pair of policies has a contrast")


def _initial(results: Results, a: str, b: str) -> Contrast | None:
    for c in results.initial_contrasts:
        if {c.a, c.b} == {a, b} and c.scenarios:
            return c if c.a == a else c.reversed()
    return None


def to_screen(found: Comparison) -> str:
    """The comparison as text, at most 100 columns where the names allow."""
    d = found.contrast.difference
    level = f"{100 * found.resampling['level']:g} %"
    rows = [
        (name, estimate, trials, invalid)
        for name, estimate, trials, invalid in zip(
            (found.a, found.b), found.rsr, found.trials, found.invalid, strict=True
        )
    ]
    columns = (
        Column("Policy"),
        Column("RSR %", "percent"),
        Column("Trials", "count"),
        Column("Invalid", "count"),
    )
    lines = [to_text(Table("rates", "", columns, tuple(rows))), ""]
    points, p = Column("", "points"), Column("", "p")
    c, r = found.contrast, found.resampling
    lines.append(
        f"A − B      {cell_text(d, points)} points ({level} interval), {found.scenarios} common scenarios"
    )
    lines.append(f"           {_bar(d)}")
    if found.tasks is not None:
        lines.append(f"           {cell_text(found.tasks, points)} for other tasks like these")
    adjusted = f"adjusted for {c.family} pairs (Holm)" if c.family > 1 else "the only pair of its family"
    shown = c.p_holm if c.complete else c.p
    adjusted = adjusted if c.complete else "not adjusted: not both are complete"
    if c.sequential:
        adjusted += "; holds at every look (sequential)"
    lines.append(
        f"p          {cell_text(shown, p)}, {adjusted}; sign flips of {c.differing} differing {c.unit}"
    )
    if found.methods is not None:
        lines += _runs_lines(found, points)
    if found.initial is not None:
        lines.append(f"initially  {cell_text(found.initial.difference, points)} points from initial states")
    w = found.profile
    lines += [
        f"profiles   A higher on {w.higher} scenarios, B on {w.lower}, equal on {w.equal}",
        f"           mean absolute difference {cell_text(w.hindsight, points)}, by chance alone "
        f"{cell_text(w.floor, points)} points",
    ]
    width = max(len(share.group) for share in found.cells) + 2
    lines += ["", f"  {'Where it comes from':<{width}}  adds up to A − B, points"]
    for share in found.cells:
        mark = " *" if share.scenarios < UNDERPOWERED_BELOW else "  "
        lines.append(
            f"  {share.group + mark:<{width}}  {100 * share.contribution:>+6.1f}   "
            f"(A − B is {100 * share.difference:+.1f} on its {share.scenarios} scenarios)"
        )
    if any(share.scenarios < UNDERPOWERED_BELOW for share in found.cells):
        lines.append(f"  * fewer than {UNDERPOWERED_BELOW} scenarios")
    these = "" if found.of_methods is None else "Of these runs: "
    lines += ["", textwrap.fill(these + found.verdict, 100)]
    if found.of_methods is not None:
        lines.append(textwrap.fill(method_text(found.of_methods), 100))
    lines += [textwrap.fill(f"Note: {remark}", 100) for remark in found.remarks]
    lines.append(f"Intervals and test over {r['units']} {r['unit']}: they speak of {r['estimand']}.")
    return "\n".join(lines)


def _runs_lines(found: Comparison, points: Column) -> list[str]:
    """How far the runs of each method lie apart."""
    lines, percent = [], Column("", "percent")
    for m in found.methods or ():
        text = (
            f"{len(m.each)} runs, {100 * m.lowest:.1f} to {100 * m.highest:.1f} %, SD {100 * m.sd:.1f} points"
        )
        if len(m.each) == 1:
            text = "1 run"
        elif not math.isnan(m.other_runs.low):
            text += f"; {cell_text(m.other_runs, percent)} % for other runs like these"
        lines.append(f"runs       {m.method}: {text}")
    if found.of_methods is not None and not math.isnan(found.of_methods.difference.low):
        of = cell_text(found.of_methods.difference, points)
        lines.append(f"           A − B {of} points for other runs like these")
    return lines


def _bar(d: Estimate) -> str:
    """The interval on a line from B better to A better."""
    if math.isnan(d.low):
        return f"interval {NOT_DEFINED}"
    reach = max(abs(d.low), abs(d.high), 0.01)
    at = lambda v: round((v / reach + 1) / 2 * (_BAR_WIDTH - 1))  # noqa: E731
    line = [" "] * _BAR_WIDTH
    line[at(d.low) : at(d.high) + 1] = ["─"] * (at(d.high) - at(d.low) + 1)
    line[at(0)] = "│"
    line[at(d.value)] = "●"
    return f"B better {''.join(line)} A better"


def to_json(found: Comparison) -> dict[str, Any]:
    """The comparison as JSON-able values; null is "not defined"."""
    return without_nan(asdict(found))


def without_nan(value: Any) -> Any:
    """The same value with null for NaN, which JSON lacks."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
