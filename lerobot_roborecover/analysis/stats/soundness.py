"""Arms that no verdict can rest on: trial counts that depend on outcomes, or no valid trial at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy import stats

from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.scenario import Outcome

DEPENDENT_BELOW = 0.01
"""Counts are taken to depend on outcomes where p of Kendall's test, of trial counts against the outcomes of
the trials that all scenarios have, is below it. An interrupted run loses trials in the order of its
scenarios, which has nothing to do with their outcomes."""
_CHECKS = {
    Outcome.STATE_MISMATCH: "the rebuilt recovery points are not the recorded ones: check the versions of "
    "simulator and assets with `roborecover doctor`, and that --env.scenarios is the set that was recorded "
    "with them",
    Outcome.SOLVED_BY_PREFIX: "the tasks are solved before the policy acts: check that --env.scenarios and "
    "the simulator's version belong together",
    Outcome.SIM_ERROR: "the simulator failed: read field `reason` of the log's rows, and run `roborecover "
    "doctor`",
    Outcome.POLICY_ERROR: "the policy failed: read field `reason` of the log's rows, and run `roborecover "
    "check policy`",
    Outcome.TIMEOUT: "simulator or policy did not answer in time: read field `reason` of the log's rows",
}
"""What to look at first, by the outcome that most trials have."""


def barred_arms(panel: Panel) -> dict[str, ComparisonVerdict]:
    """Titles of the arms that no verdict can rest on, and why."""
    found, valid = {}, valid_trials(panel)
    # By scenario, also where columns are first states: how many scenarios share one is no count of trials.
    successes: list[dict[str, list[bool]]] = [{} for _ in panel.arms]
    for (p, _), rows in sorted(panel.rows.items(), key=lambda item: item[0]):
        for row in rows:
            successes[p].setdefault(row.scenario_id, []).append(row.success)
    for p, title in enumerate(panel.arms):
        if successes[p] and not valid[p]:
            found[title] = ComparisonVerdict.NO_VALID_TRIAL
        elif counts_depend_on_outcomes(list(successes[p].values())):
            found[title] = ComparisonVerdict.COUNTS_DEPEND
    return found


def valid_trials(panel: Panel) -> np.ndarray:
    """(P,) trials of every arm that ended in success or at the horizon."""
    found = -panel.invalid.sum(1)
    for (p, _), rows in panel.rows.items():
        found[p] += len(rows)
    return found


def counts_depend_on_outcomes(successes: Sequence[Sequence[bool]]) -> bool:
    """Whether the number of trials goes with the outcomes of the first trials, which all scenarios have.

    Trials until the first success give most trials to scenarios whose first trials failed, and a mean of the
    scenarios' rates is then too high.

    Args:
        successes: of each scenario, in the order of its trials.
    """
    counts = np.array([len(s) for s in successes if s])
    if len(counts) < 2 or (counts == counts[0]).all():
        return False
    first = np.array([np.mean(s[: counts.min()]) for s in successes if s])
    if np.ptp(first) == 0:
        return False
    return bool(stats.kendalltau(counts, first).pvalue < DEPENDENT_BELOW)


def invalid_words(panel: Panel, arms: Sequence[int]) -> str:
    """How the trials of arms without a valid one ended, and what to check."""
    ended = Counter(r.outcome for (p, _), rows in panel.rows.items() if p in arms for r in rows)
    counts = ", ".join(f"{count} {name}" for name, count in ended.most_common())
    most = Outcome(ended.most_common(1)[0][0])
    return f"({counts}): {_CHECKS[most]}"
