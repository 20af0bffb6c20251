"""Everything a report says, worked out once from a study: panels, draws, and what they give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from lerobot_roborecover.analysis.completeness import incomplete_arms, ranked_subset
from lerobot_roborecover.analysis.logs import Study
from lerobot_roborecover.analysis.options import Options
from lerobot_roborecover.analysis.sequential_pairs import recorded_pairs, watched_pair
from lerobot_roborecover.analysis.sequential_plan import SequentialPlan, check_plan, plan_of, recorded_plan
from lerobot_roborecover.analysis.stats.arms import Arm
from lerobot_roborecover.analysis.stats.complete_subset import Compared, compared
from lerobot_roborecover.analysis.stats.contrasts import Contrast, adjusted, contrasts
from lerobot_roborecover.analysis.stats.costs import InterventionCost, intervention_cost
from lerobot_roborecover.analysis.stats.estimators import RowsError
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.stats.panel import Panel
from lerobot_roborecover.analysis.stats.ranking import StartRates
from lerobot_roborecover.analysis.stats.resampling import Resampling, resample
from lerobot_roborecover.analysis.stats.runs import (
    MethodContrast,
    MethodRate,
    RunRates,
    method_contrasts,
    method_rate,
    run_rates,
)
from lerobot_roborecover.analysis.stats.soundness import barred_arms
from lerobot_roborecover.analysis.stats.units import WORDS, ResamplingUnit, initial_unit
from lerobot_roborecover.analysis.stats.verdicts import ComparisonVerdict
from lerobot_roborecover.logs.sequential_record import SequentialRecord
from lerobot_roborecover.scenario import Start

MOST_PAIRS = 120
"""Pairs of policies that a figure shows, those of 16. The 7,140 of 120 policies took 209 s and 3.1 GB."""


@dataclass(frozen=True)
class Results:
    """A study's panels and draws; policies are those under direct control, interventions are apart."""

    study: Study
    options: Options
    recovery: Panel
    """Direct control from recovery points."""
    initial: Panel | None
    """The same policies from initial states, where they have such trials; a column per first state."""
    interventions: Panel | None
    """Direct baselines and interventions together, as `costs` compares them."""
    intervention_pairs: tuple[tuple[int, int], ...]
    """(baseline, intervention) indices in `interventions`."""
    remarks: tuple[str, ...]

    @cached_property
    def draws(self) -> Resampling:
        """Of the recovery panel's scenarios; shared by every number of the report on them."""
        return self.resample(self.recovery)

    def resample(self, panel: Panel, unit: ResamplingUnit | None = None) -> Resampling:
        """Units of another panel's scenarios, with the same draws, seed and level."""
        o = self.options
        return resample(panel.units(unit or o.cluster), o.draws, o.seed, o.level)

    @cached_property
    def compared(self) -> Compared:
        """Which policies are ranked, on which scenarios."""
        return ranked_subset(self.recovery, self._direct, self.options)

    @cached_property
    def _direct(self) -> list[Arm]:
        """The arms of the recovery panel, in its order."""
        of = {arm.title: arm for arm in self.study.of(Start.RECOVERY)}
        return [of[title] for title in self.recovery.arms]

    @cached_property
    def lacking(self) -> Mapping[int, str]:
        """What incomplete policies lack of what they were to be run on, by index; none has a verdict."""
        return incomplete_arms(self._direct, self.options)

    @property
    def judged(self) -> bool:
        """Whether the ranked policies are complete, or the user has asked for what they share."""
        return not any(p in self.lacking for p in self.compared.policies)

    @cached_property
    def ranked(self) -> Panel:
        """The complete policies on the scenarios that all of them were run on: headline, ranking, oracle."""
        return self.recovery.take(self.compared.policies, self.compared.scenarios)

    @cached_property
    def ranked_draws(self) -> Resampling:
        """Of the ranked panel's scenarios."""
        return self.resample(self.ranked)

    @cached_property
    def ranked_rates(self) -> list[Estimate]:
        """RSR of every ranked policy."""
        return self.ranked_draws.rates(self.ranked.rates.T)

    @cached_property
    def best_first(self) -> list[int]:
        """Indices of the ranked policies, highest RSR first."""
        rates, names = self.ranked_rates, self.ranked.arms
        return sorted(range(len(rates)), key=lambda p: (-rates[p].value, names[p]))

    @property
    def arms(self) -> list[Arm]:
        """All arms of the study, policies best first, interventions after them; starts together."""
        place = {policy: k for k, policy in enumerate(self.recovery.arms)}
        return sorted(self.study.arms, key=lambda arm: place.get(arm.policy, len(place)))

    @property
    def left_out(self) -> tuple[str, ...]:
        """Policies that are not ranked."""
        return tuple(a for p, a in enumerate(self.recovery.arms) if p not in self.compared.policies)

    @cached_property
    def tasks(self) -> Resampling | None:
        """The recovery panel's scenarios by task, for what holds of other tasks; None where units are
        tasks."""
        if self.recovery.unit(self.options.cluster) is ResamplingUnit.TASK:
            return None
        return self.resample(self.recovery, ResamplingUnit.TASK)

    @cached_property
    def barred(self) -> Mapping[str, ComparisonVerdict]:
        """Policies that no verdict can rest on, and why."""
        return barred_arms(self.recovery)

    @cached_property
    def contrasts(self) -> tuple[Contrast, ...]:
        """All pairs of policies. Those of ranked ones are one family, on the ranked scenarios."""
        chosen, count = self.compared.policies, len(self.recovery.arms)
        inside = {
            (chosen[k], chosen[m]): c
            for (k, m), c in zip(
                combinations(range(len(chosen)), 2),
                contrasts(
                    self.ranked.rates,
                    self.ranked.arms,
                    self.ranked_draws,
                    unit=self.unit,
                    complete=self.judged,
                    barred=self.barred,
                ),
                strict=True,
            )
        }
        pairs = list(combinations(range(count), 2))
        outside = [pair for pair in pairs if pair not in inside]
        found = inside | dict(
            zip(
                outside,
                contrasts(
                    self.recovery.rates,
                    self.recovery.arms,
                    self.draws,
                    outside,
                    unit=self.unit,
                    complete=False,
                    barred=self.barred,
                ),
                strict=True,
            )
        )
        return tuple(adjusted([self._watched(pair) or found[pair] for pair in pairs]))

    @property
    def shown_pairs(self) -> list[tuple[int, int]]:
        """Pairs of policies that have a row in figures and in tables that take a while: all pairs, or, where
        they are more than `MOST_PAIRS`, those with the first policy, which is the best of the ranked ones."""
        count = len(self.recovery.arms)
        every = list(combinations(range(count), 2))
        return every if len(every) <= MOST_PAIRS else every[: count - 1]

    def _watched(self, pair: tuple[int, int]) -> Contrast | None:
        """The sequential contrast of a pair whose comparison was watched, or is to be; None for others."""
        panel, level = self.recovery, self.options.level
        for indices in (pair, (pair[1], pair[0])):
            record = self._records.get((panel.arms[indices[0]], panel.arms[indices[1]]))
            if record is not None:
                check_plan(record, self.options.planned)
                found = watched_pair(panel, indices, level, recorded_plan(record, panel), record.level)
                return found if indices == pair else found.reversed()
        if not self.options.sequential:
            return None
        return watched_pair(panel, pair, level, self.sequential_plan(pair))

    def sequential_plan(self, pair: tuple[int, int]) -> SequentialPlan:
        """What the comparison of two policies of the recovery panel was to be over, by their rows."""
        o = self.options
        return plan_of(self.recovery, pair, self._direct, o.planned, o.scheduled)

    @cached_property
    def _records(self) -> Mapping[tuple[str, str], SequentialRecord]:
        return recorded_pairs(self.study.sequential, self._direct)

    def record_of(self, a: str, b: str) -> SequentialRecord | None:
        """The record that keeps the plan of two policies' comparison, in either order."""
        return self._records.get((a, b)) or self._records.get((b, a))

    @cached_property
    def runs(self) -> tuple[RunRates, ...]:
        """Every policy's runs on the recovery panel; one run where it is no method of several."""
        panel, scheduled = self.recovery, self.options.scheduled
        return tuple(run_rates(arm, panel, p, scheduled) for p, arm in enumerate(self._direct))

    @property
    def several_runs(self) -> bool:
        """Whether any policy is a method of several runs."""
        return any(len(found.runs) > 1 for found in self.runs)

    @cached_property
    def method_rates(self) -> tuple[MethodRate, ...]:
        """Rate, spread and interval of every method, in the recovery panel's order."""
        return tuple(method_rate(found, self.draws) for found in self.runs)

    @cached_property
    def method_contrasts(self) -> tuple[MethodContrast, ...]:
        """The pairs of `contrasts`, said of the methods behind the runs."""
        return method_contrasts(self.contrasts, self.runs, self.recovery, self.draws)

    @cached_property
    def initial_contrasts(self) -> tuple[Contrast, ...]:
        """The same pairs from initial states, on the first states of the same scenarios; a family of their
        own."""
        panel = self.initial
        if panel is None:
            unknown = np.full(self.recovery.rates.shape, np.nan)
            return tuple(contrasts(unknown, self.recovery.arms, self.draws, unit=self.unit))
        states = set(self._initial_columns[list(self.compared.scenarios)].tolist()) - {-1}
        keep = np.zeros((len(self.recovery.arms), len(panel.scenarios)), bool)
        keep[np.ix_(self.compared.policies, sorted(states))] = True
        keep[[p for p, arm in enumerate(self.recovery.arms) if arm in self.left_out]] = True
        rates = np.where(keep, self._rates_of_first_states, np.nan)
        return tuple(
            contrasts(rates, self.recovery.arms, self.resample(panel), unit=WORDS[self.initial_unit])
        )

    @property
    def initial_unit(self) -> ResamplingUnit:
        """What is taken as independent of initial-state trials."""
        return initial_unit(self.options.cluster)

    @cached_property
    def procedure_contrasts(self) -> tuple[Contrast, ...]:
        """Every intervention minus its direct control, in the order of `intervention_pairs`: one family."""
        panel = self.interventions
        if panel is None:
            return ()
        pairs = [(arm, base) for base, arm in self.intervention_pairs]
        draws = self.resample(panel)
        run = panel.trials > 0
        of = {arm.title: arm for arm in self.study.arms}
        lacking = incomplete_arms([of[title] for title in panel.arms], self.options)
        whole = [
            bool((run[a] == run[b]).all()) and not {a, b} & lacking.keys() for a, b in pairs
        ]  # fmt: skip
        inside = [pair for pair, ok in zip(pairs, whole, strict=True) if ok]
        outside = [pair for pair, ok in zip(pairs, whole, strict=True) if not ok]
        found = {
            pair: c
            for some, ok in ((inside, True), (outside, False))
            for pair, c in zip(
                some,
                contrasts(
                    panel.rates,
                    panel.arms,
                    draws,
                    some,
                    unit=self.unit,
                    complete=ok,
                    barred=barred_arms(panel),
                ),
                strict=True,
            )
        }
        return tuple(found[pair] for pair in pairs)

    def contrast(self, a: str, b: str) -> Contrast:
        """The contrast of two policies, or of an intervention and its direct control, a minus b.

        Raises:
            RowsError: it is no question of a family: an intervention against another policy, or another
                intervention.
        """
        for c in (*self.contrasts, *self.procedure_contrasts):
            if (c.a, c.b) == (a, b):
                return c
            if (c.a, c.b) == (b, a):
                return c.reversed()
        raise RowsError(
            f"{a} against {b} is no one question: policies are compared with policies, and an intervention "
            "with its own direct control (--baseline says which)"
        )

    @cached_property
    def _rates_of_first_states(self) -> np.ndarray:
        """(P, F) initial-state rates of the recovery panel's policies; NaN where not run."""
        if self.initial is None:
            return np.full((len(self.recovery.arms), 0), np.nan)
        of = dict(zip(self.initial.arms, self.initial.rates, strict=True))
        unknown = np.full(len(self.initial.scenarios), np.nan)
        return np.stack([of.get(policy, unknown) for policy in self.recovery.arms])

    @cached_property
    def _initial_columns(self) -> np.ndarray:
        """(N,) int: place of each recovery scenario's first state in the initial panel; -1 where none is."""
        states = [] if self.initial is None else [s.id for s in self.initial.scenarios]
        place = {state: k for k, state in enumerate(states)}
        labels = self.recovery.units(ResamplingUnit.FIRST_STATE).tolist()
        return np.array([place.get(label, -1) for label in labels], int)

    @cached_property
    def initial_rates(self) -> np.ndarray:
        """(P, N) initial-state rates of the recovery panel's policies on each scenario's first state; NaN
        where not run."""
        unknown = np.full((len(self.recovery.arms), 1), np.nan)
        return np.hstack([self._rates_of_first_states, unknown])[:, self._initial_columns]

    @cached_property
    def retention(self) -> list[Estimate]:
        """Recovery over initial-state success of every policy, over the scenarios that have both.

        First states are the units: scenarios that share one have the same initial-state trial.
        """
        draws = self.resample(self.recovery, self.initial_unit)
        return draws.ratios(self.recovery.rates.T, self.initial_rates.T)

    @cached_property
    def _matched(self) -> Compared:
        """Ranked policies and scenarios with trials from both starts, a complete table again."""
        both = np.isfinite(self.initial_rates) & np.isfinite(self.recovery.rates)
        keep = np.zeros(both.shape, bool)
        keep[np.ix_(self.compared.policies, self.compared.scenarios)] = True
        initial = {} if self.initial is None else barred_arms(self.initial)
        keep[[p for p, arm in enumerate(self.recovery.arms) if arm in self.barred or arm in initial]] = False
        return compared(both & keep, self.recovery.arms)

    @property
    def matched(self) -> list[int]:
        """Indices of the ranked policies with trials from both starts on the same scenarios; none where the
        ranked ones are incomplete."""
        return list(self._matched.policies) if self._matched.scenarios and self.judged else []

    @property
    def both_starts(self) -> tuple[StartRates, StartRates]:
        """Rates of the matched policies from initial states, by first state, and from recovery points, by
        scenario, on the scenarios that all have."""
        return self.both_starts_over(None)

    def both_starts_over(self, unit: ResamplingUnit | None) -> tuple[StartRates, StartRates]:
        """The same over another unit, for both starts; None takes each start's own."""
        names = tuple(self.recovery.arms[p] for p in self.matched)
        scenarios = self._matched.scenarios
        states = sorted(set(self._initial_columns[list(scenarios)].tolist()) - {-1})
        before = self._rates_of_first_states[np.ix_(self.matched, states)]
        units = [] if self.initial is None else self.initial.units(unit or self.options.cluster)[states]
        o = self.options
        return (
            StartRates(names, before, resample(units, o.draws, o.seed, o.level)),
            StartRates(
                names,
                self.recovery.rates[np.ix_(self.matched, scenarios)],
                self.resample(self.recovery, unit).part(np.array(scenarios, int)),
            ),
        )

    @cached_property
    def costs(self) -> list[InterventionCost]:
        """Every intervention against its direct baseline."""
        if self.interventions is None:
            return []
        draws = self.resample(self.interventions)
        return [intervention_cost(self.interventions, b, a, draws) for b, a in self.intervention_pairs]

    @property
    def unit(self) -> str:
        """What is taken as independent, in words."""
        return WORDS[self.recovery.unit(self.options.cluster)]
