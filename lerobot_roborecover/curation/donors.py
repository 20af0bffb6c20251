"""Donors: other policies' recoveries where the base policy fails, to train Correction on.

As the paper has it ("Setup" of the interventions; appendix, "Correction Data and Training"):

1. of the training scenarios, those that the base recovers in less than 40 % of its trials;
2. the alternatives that recover one in more than 60 % of theirs are its candidates;
3. four trials each; a candidate stays with at least three successes and every trial complete (one trial of a
   policy that does the same in every trial counts as all);
4. one trajectory per source record: the best candidate's first success;
5. it is replayed, must succeed again, and its observations are rendered as it goes.

What falls out on the way is counted with its reason.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.funnel import StageCounts
from lerobot_roborecover.curation.policy_trials import check_repeats
from lerobot_roborecover.curation.split import MEASURED
from lerobot_roborecover.datasets.rendered_steps import RenderedSteps, RenderJob, replayed
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
from lerobot_roborecover.logs.row import LoggedTrial, TrialRow
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError, Start
from lerobot_roborecover.utils.options import option
from lerobot_roborecover.utils.text import pluralize


@dataclass(frozen=True)
class DonorOptions:
    """Thresholds; the defaults are the paper's."""

    base_below: float = option(0.4, name="max-base-rate", old=("base-below",))
    """The base recovers a scenario less often."""
    donor_above: float = option(0.6, name="min-donor-rate", old=("donor-above",))
    """An alternative recovers it more often."""
    trials: int = 4
    """Trials of each candidate."""
    successes: int = 3
    """Successes of these, at least."""
    per_record: int = 1
    """Trajectories per source record.

    Different ones that are kept, at most.
    """
    deterministic: tuple[str, ...] = option((), metavar="CHECKPOINT")
    """This alternative (or its name in the logs) does the same in every trial: one of each candidate counts
    as all."""

    def __post_init__(self):
        if not 0.0 <= self.base_below <= 1.0 or not 0.0 <= self.donor_above < 1.0:
            raise ScenarioError(
                f"base below {self.base_below} and donors above {self.donor_above}: rates are from 0 to 1"
            )
        if not 1 <= self.successes <= self.trials or self.per_record < 1:
            raise ScenarioError(
                f"{self.successes} successes of {self.trials} trials, {self.per_record} per record: must be "
                "at least 1, and no more successes than trials"
            )

    def trials_of(self, policy: str) -> int:
        """How many are run of a candidate."""
        return 1 if policy in self.deterministic else self.trials


@dataclass(frozen=True)
class DonorCandidate:
    """An alternative on a scenario that the base does badly on."""

    scenario: Scenario
    policy: str
    """As in the trial logs."""
    base_rate: float
    donor_rate: float
    """Donor rate of the selection's trials."""


@dataclass(frozen=True)
class Donor:
    """A candidate that passed its four trials."""

    candidate: DonorCandidate
    trials: tuple[LoggedTrial, ...]
    """All of them, by index."""

    @property
    def successes(self) -> list[LoggedTrial]:
        return [t for t in self.trials if t.row.success]


def add_step(funnel: list[StageCounts], what: str, kept: int, dropped: Counter[str] | None = None) -> None:
    """Adds a step to a funnel: what is left, and why the others are not.

    What is counted may change on the way, from scenarios to trajectories of them; nothing is undecided.
    """
    reasons = tuple((dropped or Counter()).most_common())
    funnel.append(StageCounts(what, funnel[-1].kept if funnel else kept, kept, reasons, 0))


def funnel_table(funnel: Sequence[StageCounts]) -> str:
    """How many were left after each step, in plain text."""
    lines = []
    for step in funnel:
        lines += [f"{'':8}- {n} {reason}" for reason, n in step.dropped]
        lines.append(f"{step.kept:6}  {step.stage}")
    return "\n".join(lines)


def choose_candidates(
    scenarios: Iterable[Scenario],
    rows: Iterable[TrialRow],
    base: str,
    options: DonorOptions,
    funnel: list[StageCounts],
) -> list[DonorCandidate]:
    """Scenarios and alternatives whose rates call for a donor.

    Args:
        scenarios: of the training split.
        rows: trials of the base and of the alternatives; only those from the recovery point, on these
            scenarios, are read. An invalid trial counts as a failure.
        base: the base policy, as its rows name it.
        options: thresholds.
        funnel: counts what stays.

    Raises:
        ScenarioError: no row is of the base.
    """
    by_hash = {s.sha256(): s for s in scenarios}
    results: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    policies: Counter[str] = Counter()
    for row in rows:
        if row.start == Start.RECOVERY.value and not row.interventions:
            policies[row.policy] += 1
            if row.scenario_sha256 in by_hash:
                results[row.scenario_sha256][row.policy].append(row.success)
    if base not in policies:
        raise ScenarioError(
            f"no trial from the recovery point is by {base!r}; the logs have {sorted(policies)}. Name one of "
            "them with --base"
        )
    dropped: Counter = Counter()
    found: list[DonorCandidate] = []
    for sha, scenario in by_hash.items():
        rates = {policy: float(np.mean(done)) for policy, done in results[sha].items()}
        if scenario.split in MEASURED:
            dropped[f"of the {scenario.split} split, which must not train anything"] += 1
        elif base not in rates:
            dropped["without a trial of the base"] += 1
        elif rates[base] >= options.base_below:
            dropped[f"recovered by the base in {options.base_below:.0%} or more"] += 1
        else:
            able = [p for p in sorted(rates) if p != base and rates[p] > options.donor_above]
            if not able:
                dropped[f"recovered by no alternative in more than {options.donor_above:.0%}"] += 1
            found += [DonorCandidate(scenario, p, rates[base], rates[p]) for p in able]
    add_step(
        funnel, "scenarios with an alternative that does better", len({c.scenario.id for c in found}), dropped
    )
    add_step(funnel, "candidates: such a scenario and one alternative", len(found))
    return found


def judge(
    candidates: Iterable[DonorCandidate],
    trials: Iterable[LoggedTrial],
    options: DonorOptions,
    funnel: list[StageCounts],
) -> list[Donor]:
    """Candidates whose trials are complete and mostly succeed.

    Args:
        candidates: from `choose_candidates`.
        trials: of the candidates' policies, with actions; others are ignored.
        options: thresholds.
        funnel: counts what stays.

    Raises:
        ScenarioError: two trials of a policy that is said to be deterministic differ.
    """
    of: dict[tuple[str, str], dict[int, LoggedTrial]] = defaultdict(dict)
    for trial in trials:
        if trial.row.start == Start.RECOVERY.value and not trial.row.interventions:
            of[trial.row.scenario_sha256, trial.row.policy].setdefault(trial.row.trial, trial)
    donors, dropped = [], Counter()
    for candidate in candidates:
        mine = of[candidate.scenario.sha256(), candidate.policy]
        wanted = options.trials_of(candidate.policy)
        if candidate.policy in options.deterministic:
            check_repeats(candidate.policy, [mine[k].row for k in sorted(mine)])
        four = [mine[k] for k in sorted(mine)[:wanted]]
        complete = [t for t in four if Outcome(t.row.outcome).valid]
        donor = Donor(candidate, tuple(four))
        if len(four) < wanted:
            dropped[f"with fewer than {pluralize(wanted, 'trial')}"] += 1
        elif len(complete) < wanted:
            dropped["with a trial that did not complete"] += 1
        elif len(donor.successes) < min(options.successes, wanted):
            dropped[f"with fewer than {options.successes} successes in {options.trials}"] += 1
        else:
            donors.append(donor)
    what = f"donors: {options.successes} of {options.trials} trials succeed, all complete"
    what += "; the one trial of a deterministic policy" if options.deterministic else ""
    add_step(funnel, what, len(donors), dropped)
    return donors


def source_record(scenario: Scenario) -> str:
    """What a scenario was made from: the trajectory it shares with the others of its cluster."""
    return scenario.cluster or scenario.id


def deduplicate(
    donors: Iterable[Donor], options: DonorOptions, funnel: list[StageCounts]
) -> list[tuple[Donor, LoggedTrial]]:
    """At most `per_record` trajectories of each source record, none of them twice.

    The donor with the most successes goes first, then the one with the better rate, then the quicker one.
    """
    by_record: dict[str, list[Donor]] = defaultdict(list)
    for donor in donors:
        by_record[source_record(donor.candidate.scenario)].append(donor)
    kept, dropped = [], Counter()
    for record in sorted(by_record):
        group = sorted(by_record[record], key=_preference)
        seen: set[str] = set()
        for donor in group:
            fresh = [t for t in donor.successes if t.row.actions_sha256 not in seen]
            taken: list[LoggedTrial] = []
            for trial in fresh:
                if len(seen) < options.per_record and trial.row.actions_sha256 not in seen:
                    seen.add(trial.row.actions_sha256)
                    taken.append(trial)
            if not taken:
                dropped["of a source record that has its trajectory already"] += 1
            kept += [(donor, trial) for trial in taken]
    add_step(funnel, "trajectories", len(kept), dropped)
    return kept


def _preference(donor: Donor) -> tuple:
    c, won = donor.candidate, donor.successes
    return (
        -len(won) / len(donor.trials),
        -c.donor_rate,
        float(np.mean([t.row.steps for t in won])),
        c.policy,
        c.scenario.id,
    )


def write_donors(
    root: Path,
    chosen: Sequence[tuple[Donor, LoggedTrial]],
    *,
    simulator: Mapping[str, Any],
    workers: int,
    funnel: list[StageCounts],
    description: str = "",
    license: str | None = None,
    on_trajectory: Callable[[int, int], None] = lambda done, total: None,
    also: Callable[[Path], object] = lambda folder: None,
) -> int:
    """Replays, checks and writes the trajectories; how many were written.

    Args:
        root: the dataset's folder; must be new or empty.
        chosen: from `deduplicate`.
        simulator: its options, which decide the observations.
        workers: processes that replay.
        funnel: counts what stays, and is described in the dataset's manifest.
        description: free text.
        license: SPDX identifier, or None where none is decided.
        on_trajectory: called with how many are done of how many.
        also: writes further files into the folder before it appears; `funnel` is complete then.

    Raises:
        ScenarioError: there is nothing to write.
    """
    from lerobot_roborecover.datasets.episodes import to_frame
    from lerobot_roborecover.platforms import make_simulator

    if not chosen:
        raise ScenarioError(
            f"no trajectory is left for {root}:\n{funnel_table(funnel)}\nRun more alternatives, or more "
            "scenarios"
        )
    dropped: Counter = Counter()
    platform = chosen[0][0].candidate.scenario.platform
    probe = make_simulator(platform, **simulator)
    fps = round(probe.control_hz)
    probe.close()

    def trajectories() -> Iterator[Trajectory]:
        jobs = [_job(donor, trial) for donor, trial in chosen]
        replays = zip(chosen, replayed(jobs, simulator, workers), strict=True)
        for number, ((donor, trial), replay) in enumerate(replays, 1):
            problem = _problem(replay, trial)
            if problem:
                dropped[problem] += 1
            else:
                frames = [to_frame(platform, o) for o in replay.observations]
                yield _trajectory(donor, trial, frames)
            on_trajectory(number, len(chosen))

    def finish(folder: Path) -> None:
        replayed_again = len(chosen) - dropped.total()
        add_step(funnel, "trajectories that succeed again when replayed", replayed_again, dropped)
        also(folder)

    write_trajectories(
        root, "donors", trajectories(), fps=fps, description=description, license=license, also=finish
    )
    return len(chosen) - dropped.total()


def _job(donor: Donor, trial: LoggedTrial) -> RenderJob:
    t = len(donor.candidate.scenario.prefix)
    return RenderJob(donor.candidate.scenario, trial.actions, np.arange(t, t + len(trial.actions)))


def _problem(replay: RenderedSteps, trial: LoggedTrial) -> str:
    if not replay.succeeded:
        return "whose replay does not succeed"
    if len(replay.observations) != len(trial.actions):
        return "whose replay ends early"
    return ""


def _trajectory(donor: Donor, trial: LoggedTrial, frames: list) -> Trajectory:
    candidate = donor.candidate
    scenario = candidate.scenario
    return Trajectory(
        task=scenario.task,
        driver=candidate.policy,
        actions=trial.actions.astype(np.float64),
        frames=frames,
        success=True,
        scenario=scenario,
        first_step=len(scenario.prefix),
        trial=trial.row.trial,
        provenance={
            "source_record": source_record(scenario),
            "trials": len(donor.trials),
            "successes": len(donor.successes),
            "base_rate": candidate.base_rate,
            "donor_rate": candidate.donor_rate,
            "actions_dtype": str(trial.actions.dtype),
        },
    )


def describe(options: DonorOptions, base: str, funnel: list[StageCounts]) -> dict[str, Any]:
    """What the dataset's `donors.json` says."""
    steps = [{"step": s.stage, "count": s.kept, "dropped": dict(s.dropped)} for s in funnel]
    return {"base": base, "options": asdict(options), "funnel": steps}
