"""From a study to its results: which arms are direct control, initial states and interventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lerobot_roborecover.analysis.completeness import ranked_subset
from lerobot_roborecover.analysis.logs import Study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.results import Results
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.panel import make_panel
from lerobot_roborecover.analysis.stats.resampling import masked_mean
from lerobot_roborecover.analysis.stats.soundness import barred_arms
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.scenario import Start


def analyse(study: Study, options: Options | None = None) -> Results:
    """Sorts a study's arms into direct control, initial states and interventions.

    Args:
        study: the trials.
        options: draws, seed, and the like.

    Raises:
        RowsError: there is no direct control from recovery points, or a named policy does not exist.
    """
    options = options or Options()
    for name in (*([options.baseline] if options.baseline else []), *options.interventions):
        if name not in study.policies:
            raise RowsError(f"no policy {name!r} in the logs; there are {', '.join(study.policies)}")
    recovery = study.of(Start.RECOVERY)
    acting = [arm for arm in recovery if _intervenes(arm, options) and arm.policy != options.baseline]
    direct = _best_first([arm for arm in recovery if arm not in acting], options)
    if not direct:
        what = (
            ", ".join(sorted({arm.start.value for arm in study.arms if arm not in acting}))
            or "none but interventions"
        )
        raise RowsError(
            f"no trials from recovery points by a policy without an intervention (there are: {what}). Give "
            "the log of a run with --env.start=recovery, the default, too; or name the policy with --baseline"
        )
    remarks = list(study.remarks)
    chosen, pairs = _pair(direct, [*acting, *study.of(Start.REVERSION)], options, remarks)
    initial = [
        replace(arm, start=Start.RECOVERY, rewind_steps=(0,))  # titled by the policy alone
        for arm in study.of(Start.INITIAL)
        if arm.policy in {d.policy for d in direct}
    ]
    remarks += _initial_remarks(direct, initial)
    panel = make_panel(direct, options.scheduled)
    if words := ranked_subset(panel, direct, options).words:
        remarks.append(words)
    remarks += [
        f"{name}: its trial counts go with its outcomes (more trials where the first ones failed, or fewer), "
        "so its rate is biased and has no verdict. Evaluate every scenario the same number of times"
        for name, why in barred_arms(panel).items()
        if why is ComparisonVerdict.COUNTS_DEPEND
    ]
    if options.common and not (panel.trials > 0).all(0).any():
        raise RowsError("--shared-scenarios-only: no scenario was run by all policies")
    return Results(
        study,
        options,
        panel,
        make_panel(initial).by_first_state() if initial else None,
        make_panel(chosen, options.scheduled) if pairs else None,
        tuple(pairs),
        tuple(remarks),
    )


def _best_first(direct: Sequence[Arm], options: Options) -> list[Arm]:
    """Policies as every table and figure shows them: highest RSR first, those that are not ranked last."""
    if len(direct) < 2:
        return list(direct)
    panel = make_panel(direct, options.scheduled)
    chosen = ranked_subset(panel, direct, options)
    whole = panel.rates[:, list(chosen.scenarios)] if chosen.scenarios else panel.rates
    ranked = {p: float(whole[p].mean()) for p in chosen.policies}
    others = masked_mean(panel.rates.T)

    def place(p: int) -> tuple[bool, float, str]:
        return p not in ranked, -ranked.get(p, others[p]), panel.arms[p]

    return [direct[p] for p in sorted(range(len(direct)), key=place)]


def _initial_remarks(direct: Sequence[Arm], initial: Sequence[Arm]) -> list[str]:
    if not initial and all(row.robot is not None for arm in direct for row in arm.rows):
        return []  # a robot has recovery points alone
    if not initial:
        return [
            "no trials from initial states: run lerobot-eval once more with --env.start=initial to see what "
            "recovery costs each policy"
        ]
    having = {arm.policy for arm in initial}
    return [
        f"{arm.policy}: no trials from initial states, so no rank change and no retention"
        for arm in direct
        if arm.policy not in having
    ]


def _intervenes(arm: Arm, options: Options) -> bool:
    return arm.policy in options.interventions or arm.intervenes


def _pair(
    direct: Sequence[Arm], interventions: Sequence[Arm], options: Options, remarks: list[str]
) -> tuple[list[Arm], list[tuple[int, int]]]:
    """Arms of the intervention panel and its (baseline, intervention) index pairs."""
    policies = [arm.policy for arm in direct]
    chosen: list[Arm] = []
    pairs = []
    for arm in interventions:
        if arm.start is Start.REVERSION and arm.policy in policies:
            name = arm.policy
        else:
            name = options.baseline or (policies[0] if len(policies) == 1 else None)
        if name is None or name not in policies:
            remarks.append(f"{arm.title} intervenes, but --baseline does not say what to compare it with")
            continue
        baseline = direct[policies.index(name)]
        for member in (baseline, arm):
            if member not in chosen:
                chosen.append(member)
        pairs.append((chosen.index(baseline), chosen.index(arm)))
    return chosen, pairs
