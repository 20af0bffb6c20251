"""What an intervention costs and what it breaks, against direct control of the same scenarios.

An entry of a row's `interventions` is an object with `kind` and `step`, or the pair of the two. Kinds are
counted as they are named: `rollback`, `correction`, `takeover`; the entry of kind `monitor` may carry
`calls`, how often the monitor was asked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.resampling import Resampling
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import TrialLogError


@dataclass(frozen=True)
class InterventionCost:
    """One intervention against direct control, on the scenarios that both were run on."""

    baseline: str
    arm: str
    scenarios: int
    direct: Estimate
    """RSR of direct control."""
    with_intervention: Estimate
    gain: Estimate
    extra_steps: Estimate
    """Environment steps per trial more than direct control; a rewound start's steps count as all others."""
    triggered: Estimate
    """Share of trials in which anything intervened (monitor calls alone do not count); NaN where the logs do
    not say."""
    per_trial: Mapping[str, float]
    """Mean count of each kind per trial; `monitor calls` among them."""
    matched: int
    """Trials that both have: same scenario, same trial index."""
    rescued: int
    """Matched trials that direct control fails and the intervention solves."""
    harmed: int
    """Matched trials that direct control solves and the intervention loses."""


def intervention_cost(panel: Panel, baseline: int, arm: int, resampling: Resampling) -> InterventionCost:
    """Compares two arms of a panel.

    Args:
        panel: both arms, on the same scenarios.
        baseline: index of direct control.
        arm: index of the intervention.
        resampling: of the panel's scenarios.

    Raises:
        TrialLogError: an entry of `interventions` cannot be read.
    """
    count = len(panel.scenarios)
    both = np.isfinite(panel.rates[baseline]) & np.isfinite(panel.rates[arm])
    steps, triggered = np.full(count, np.nan), np.full(count, np.nan)
    totals: Counter[str] = Counter()
    trials = matched = rescued = harmed = 0
    # Logs without any entry, of a rewound start or of stored outcomes, do not say when something intervened.
    told = any(r.interventions for (p, _), rows in panel.rows.items() if p == arm for r in rows)
    for n in np.flatnonzero(both):
        direct, acted = panel.rows.get((baseline, n), ()), panel.rows.get((arm, n), ())
        if not direct or not acted:
            continue
        steps[n] = np.mean([r.steps for r in acted]) - np.mean([r.steps for r in direct])
        kinds = [intervention_kinds(r) for r in acted]
        if told:
            triggered[n] = np.mean([any(k != "monitor calls" for k in kind) for kind in kinds])
        for kind in kinds:
            totals.update(kind)
        trials += len(acted)
        before = {r.trial: r.success for r in direct}
        for row in acted:
            if row.trial in before:
                matched += 1
                rescued += row.success and not before[row.trial]
                harmed += before[row.trial] and not row.success
    rates = np.where(both, panel.rates[[baseline, arm]], np.nan)
    direct, acted, share = resampling.rates(np.stack([rates[0], rates[1], triggered], 1))
    (gain,) = resampling.differences((rates[1] - rates[0])[:, None])
    # Steps lie between none and the horizon: few trials of many equal ones must not look sure of themselves.
    most = max(
        [s.horizon for s in panel.scenarios] + [float(np.abs(steps[np.isfinite(steps)]).max(initial=1))]
    )
    (share_of_most,) = resampling.differences(steps[:, None] / most)
    extra = Estimate(*(most * v for v in (share_of_most.value, share_of_most.low, share_of_most.high)))
    return InterventionCost(
        panel.arms[baseline],
        panel.arms[arm],
        int(both.sum()),
        direct,
        acted,
        gain,
        extra,
        share,
        {kind: total / trials for kind, total in sorted(totals.items())},
        matched,
        rescued,
        harmed,
    )


def intervention_kinds(row: TrialRow) -> Counter[str]:
    """How often each kind occurs in a trial.

    Raises:
        TrialLogError: an entry is neither an object with a `kind` nor a pair that starts with one.
    """
    kinds: Counter[str] = Counter()
    for entry in row.interventions:
        if isinstance(entry, dict) and isinstance(entry.get("kind"), str):
            kind, calls = entry["kind"], entry.get("calls")
        elif isinstance(entry, list) and entry and isinstance(entry[0], str):
            kind, calls = entry[0], None
        else:
            raise TrialLogError(
                f"trial {row.trial} of {row.scenario_id} by {row.policy}: intervention "
                f"{str(entry)[:80]} is neither "
                "an object with 'kind' and 'step' nor a pair of the two"
            )
        if kind == "monitor":
            if isinstance(calls, int):
                kinds["monitor calls"] += calls
        else:
            kinds[kind] += 1
    return kinds
