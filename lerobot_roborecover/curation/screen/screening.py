"""Which scenarios are of intermediate difficulty, by how often screening policies recover from them.

Each scenario is run from its recovery point by every policy several times; it stays where the successes of
all policies together lie within bounds. The paper: four policies, five trials, 2 to 18 successes of 20, which
is 10 % to 90 % ("Policy Difficulty Filtering"). Pure functions of trial rows.

Trials that can no longer change a verdict need not be run (curtailed sampling): the verdicts are the same,
only the counts are not complete. `give_up` goes further: it drops what none of its first trials recovered.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

from lerobot_roborecover.curation.funnel import Decision
from lerobot_roborecover.curation.policy_trials import check_repeats
from lerobot_roborecover.curation.validate.validation import ValidationRule
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError, Start
from lerobot_roborecover.utils.options import option

KEEP = ("0.1", "0.9")
"""Shares of all trials (paper: a recovery rate between 10 % and 90 %); 2 to 18 of 20."""
CURTAILED_LEAST = ValidationRule.runs
"""Trials that every scenario gets, however early its verdict is settled: as many as `validate` replays."""


@dataclass(frozen=True)
class ScreenRule:
    """Which scenarios stay; the defaults are the paper's."""

    trials: int = 5
    """Trials of each policy on each scenario."""
    keep: tuple[str, str] = option(KEEP, metavar=("FEWEST", "MOST"))
    """Successes of all policies together that stay: two counts, or two shares of all trials (0.1 0.9: 2 to 18
    of 20)."""
    max_invalid: int = option(0, metavar="N")
    """Invalid trials that a scenario may have; they count as failures.

    With more it is dropped.
    """
    curtail: bool = option(False, name="early-stop", old=("curtail",))
    """Stop trying a scenario once no further trial could change whether it stays (after three, which
    validation replays): the same scenarios stay after fewer trials; deterministic policies come first. Name
    the best policy first: it is tried on the hard scenarios, the last on the easy ones.

    A trial that is invalid can still change a verdict.
    """
    give_up: int = option(0, name="give-up-after", metavar="N")
    """With --early-stop, drop a scenario as too hard once N trials have failed and none has succeeded; 0
    tries on while enough of them might still succeed.

    One trial of a deterministic policy counts as all of its trials.
    """

    def __post_init__(self):
        if self.trials < 1 or self.max_invalid < 0:
            raise ScenarioError(
                f"{self.trials} trials, at most {self.max_invalid} invalid: there must be at least one "
                "trial, and no fewer than 0 invalid ones"
            )
        if self.give_up < 0 or (self.give_up and not self.curtail):
            raise ScenarioError(
                f"give up after {self.give_up} trials: this is a number of trials, 1 or more, and needs "
                "--early-stop"
            )
        self.bounds(1)

    def bounds(self, policies: int) -> tuple[int, int]:
        """Fewest and most successes, with so many policies.

        Raises:
            ScenarioError: they are not counts or shares in order, or there are not as many trials.
        """
        total = policies * self.trials
        shares = ["." in str(text) for text in self.keep]
        try:
            low, high = (Fraction(str(text)) for text in self.keep)
        except (ValueError, ZeroDivisionError):
            low, high = Fraction(-1), Fraction(-1)
        if shares[0] != shares[1] or not 0 <= low <= high or (shares[0] and high > 1):
            raise ScenarioError(
                f"keep {self.keep[0]} to {self.keep[1]}: neither two counts in order, such as 2 18, nor two "
                "shares of all trials, such as 0.1 0.9"
            )
        if shares[0]:
            return math.ceil(low * total), math.floor(high * total)
        if low.denominator != 1 or high.denominator != 1:
            raise ScenarioError(f"keep {self.keep[0]} to {self.keep[1]}: counts are whole numbers")
        return int(low), int(high)

    def check(self, policies: int) -> tuple[int, int]:
        """The bounds, once it is known how many policies there are.

        Raises:
            ScenarioError: nothing, or everything, would be kept whatever happens.
        """
        low, high = self.bounds(policies)
        total = policies * self.trials
        if low > high or low > total:
            raise ScenarioError(
                f"keep {self.keep[0]} to {self.keep[1]}: of {policies} policies x {self.trials} trials = "
                f"{total} no scenario can stay ({low} to {high} successes). Give other bounds with "
                "--keep, or more trials"
            )
        return low, min(high, total)


@dataclass(frozen=True)
class PolicyCount:
    """One policy's trials on one scenario."""

    policy: str
    """As trial rows name it: checkpoint and content hash or commit."""
    successes: int
    trials: int
    invalid: Mapping[str, int]
    """Trials by invalid outcome."""
    each_counts: int = 1
    """As how many of the rule's trials a trial counts: all of them, where the policy is deterministic."""


@dataclass(frozen=True)
class Screened:
    """One scenario's trials and what they amount to."""

    scenario: Scenario
    counts: Mapping[str, PolicyCount]
    """Counts by the policy's name in this screening."""
    rule: ScreenRule
    unscreened: bool = False
    """Whether it was drawn before screening: it stays, and needs no more trials than it is validated with."""

    @property
    def successes(self) -> int:
        return sum(c.successes * c.each_counts for c in self.counts.values())

    @property
    def trials(self) -> int:
        return sum(c.trials * c.each_counts for c in self.counts.values())

    @property
    def planned(self) -> int:
        """Trials of the rule, of all policies."""
        return len(self.counts) * self.rule.trials

    @property
    def complete(self) -> bool:
        """Whether all of them have been run."""
        return self.trials >= self.planned

    @property
    def settled(self) -> bool:
        """Whether there are enough trials to validate with, and those that have not been run could not change
        the verdict, if trials decide it."""
        return self.complete or (self._run >= CURTAILED_LEAST and (self.unscreened or self._settled_by(0, 0)))

    @property
    def soonest(self) -> int:
        """How many more trials, counting once each, can settle the verdict at best; 0 where it is settled."""
        left = self.planned - self.trials
        least = 0 if self.settled else max(1, CURTAILED_LEAST - self._run)
        if self.unscreened:
            return min(least, left)
        for more in range(least, left):
            if any(self._settled_by(successes, more) for successes in range(more + 1)):
                return more
        return max(left, 0)

    @property
    def _run(self) -> int:
        return sum(c.trials for c in self.counts.values())

    def _settled_by(self, successes: int, more: int) -> bool:
        low, high = self.rule.check(len(self.counts))
        won = self.successes + successes
        could = won + self.planned - self.trials - more
        given_up = won == 0 < low and 0 < self.rule.give_up <= self.trials + more
        return given_up or could < low or won > high or (low <= won and could <= high)

    @property
    def invalid(self) -> Counter[str]:
        """Invalid trials of all policies, by outcome."""
        found: Counter[str] = Counter()
        for count in self.counts.values():
            found.update({outcome: n * count.each_counts for outcome, n in count.invalid.items()})
        return found

    @cached_property
    def decision(self) -> Decision:
        """Whether it stays, and why not."""
        low, high = self.rule.check(len(self.counts))
        each = ", ".join(
            f"{name} {c.successes}/{c.trials}{f' (x {c.each_counts})' if c.each_counts > 1 else ''}"
            for name, c in self.counts.items()
        )
        total = "" if self.complete else f" of {self.planned}"
        detail = f"{self.successes} of {self.trials} successes ({each}); {low} to {high}{total} stay"
        if self.invalid:
            named = sorted(self.invalid.items())
            detail += "; invalid: " + ", ".join(f"{n} {outcome}" for outcome, n in named)
        reason = ""
        if self.invalid.total() > self.rule.max_invalid:
            reason = f"invalid trials: {', '.join(sorted(self.invalid))}"
        elif self.successes > high:
            reason = "too easy"
        elif self.successes < low:
            reason = "too hard"
        by = f"{self.trials} trials of {len(self.counts)} policies"
        return Decision(self.scenario.id, "screen", "dropped" if reason else "kept", reason, detail, by)


def screen(
    scenarios: Sequence[Scenario],
    rows: Mapping[str, Sequence[TrialRow]],
    rule: ScreenRule,
    deterministic: Collection[str] = (),
    unscreened: Collection[str] = (),
) -> list[Screened]:
    """Judges every scenario.

    Args:
        scenarios: in any order.
        rows: trials by the policy's name; those of other scenarios, from other starts, or beyond the rule's
            number of trials are left out. Their order does not matter.
        rule: who stays.
        deterministic: names of policies that do the same in every trial: one of each scenario counts as all.
        unscreened: ids of the sample that was drawn before screening.

    Returns:
        One result a scenario, in their order.

    Raises:
        ScenarioError: a scenario lacks a trial that its verdict needs, or two trials of a deterministic
            policy differ.
    """
    found = count_outcomes(scenarios, rows, rule, deterministic, unscreened)
    for one in found:
        if one.complete or (rule.curtail and one.settled):
            continue
        for name, count in one.counts.items():
            needed = 1 if name in deterministic else rule.trials
            if count.trials < needed:
                raise ScenarioError(
                    f"scenario {one.scenario.id} has {count.trials} of {needed} trials by {name}; run the "
                    "command again to finish them"
                )
    return found


def count_outcomes(
    scenarios: Sequence[Scenario],
    rows: Mapping[str, Sequence[TrialRow]],
    rule: ScreenRule,
    deterministic: Collection[str] = (),
    unscreened: Collection[str] = (),
) -> list[Screened]:
    """Counts the trials that there are, whether or not they suffice; arguments are those of `screen`.

    Raises:
        ScenarioError: two trials of a deterministic policy differ.
    """
    rule.check(len(rows))
    of: dict[tuple[str, str, str], dict[int, TrialRow]] = defaultdict(dict)
    for name, given in rows.items():
        for row in given:
            if row.start == Start.RECOVERY.value and not row.interventions and row.trial < rule.trials:
                of[name, row.scenario_id, row.scenario_sha256][row.trial] = row
    result = []
    for scenario in scenarios:
        counts = {}
        for name in sorted(rows):
            mine = of[name, scenario.id, scenario.sha256()]
            found, each_counts = [mine[trial] for trial in sorted(mine)], 1
            if name in deterministic and found:
                check_repeats(name, found)
                found, each_counts = found[:1], rule.trials
            counts[name] = _count(found, each_counts)
        result.append(Screened(scenario, counts, rule, scenario.id in unscreened))
    return result


def _count(rows: Sequence[TrialRow], each_counts: int) -> PolicyCount:
    invalid = Counter(r.outcome for r in rows if not Outcome(r.outcome).valid)
    policies = sorted({r.policy for r in rows})
    return PolicyCount(
        policies[0] if len(policies) == 1 else ", ".join(policies),
        sum(r.success for r in rows),
        len(rows),
        dict(sorted(invalid.items())),
        each_counts,
    )


def provenance_of(found: Screened, run_seed: int) -> dict[str, Any]:
    """What a scenario keeps of its screening."""
    planned = {} if found.complete else {"planned": found.planned}
    return {
        "successes": found.successes,
        "trials": found.trials,
        **planned,
        "keep": list(found.rule.check(len(found.counts))),
        "run_seed": run_seed,
        "policies": {name: asdict(count) for name, count in found.counts.items()},
    }
