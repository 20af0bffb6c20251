"""Which logged trials are forked, and at which of their steps."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.analysis.stats.fork_gain import FORK
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, LoggedTrial, TrialRow, read_actions
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.scenario import Outcome, Scenario, ScenarioError
from lerobot_roborecover.utils.options import option

OF = ("all", "failures", "successes")


def _steps(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(step) for step in text.split(",") if step.strip())
    except ValueError:
        raise OptionError(f"--steps={text}: steps, e.g. 0,40,80") from None


@dataclass(frozen=True)
class Choice:
    """Which trials, and which steps."""

    of: str = option("all", name="outcome", choices=OF, old=("of",))
    """Which trials.

    Only `all` says what an intervention gains on average.
    """
    trials: int = option(0, text="")
    """Trials of each scenario, at most (all)."""
    every: int = option(25, name="stride", old=("every",))
    """Fork every so many steps, from the handoff on."""
    at: tuple[int, ...] = option((), name="steps", metavar="STEPS", text="", parse=_steps, old=("at",))
    """Fork at these steps instead, e.g. 0,40,80."""

    def __post_init__(self):
        if self.of not in OF:
            raise ScenarioError(f"--outcome={self.of}: not one of {', '.join(OF)}")
        if self.every < 1 or self.trials < 0 or any(step < 0 for step in self.at):
            raise ScenarioError(
                f"stride {self.every}, trials {self.trials}, steps {list(self.at)}: steps and counts are not "
                "negative, and --stride is at least 1"
            )

    def steps(self, trial: LoggedTrial) -> list[int]:
        """Steps at which a trial is forked: those it went on from."""
        wanted = self.at or range(0, trial.row.steps, self.every)
        return [step for step in sorted(set(wanted)) if step < trial.row.steps]


def rows_of(logs: Sequence[Path], policy: str) -> list[tuple[Path, TrialRow]]:
    """Rows of one policy, with the folder that has their actions.

    Raises:
        ScenarioError: no log has one.
        TrialLogError: a log is damaged.
    """
    found = [(log.with_name(ACTIONS_FOLDER), row) for log in logs for row in read_trial_log(log)]
    mine = [(folder, row) for folder, row in found if row.policy == policy]
    if not mine:
        raise ScenarioError(
            f"no trial in {', '.join(map(str, logs))} is by {policy}; there are trials by "
            f"{sorted({row.policy for _, row in found}) or 'no policy'}. Name the checkpoint that ran them "
            "with --policy"
        )
    return mine


def usable(
    rows: Iterable[tuple[Path, TrialRow]], choice: Choice
) -> tuple[list[tuple[Path, TrialRow]], Counter]:
    """Rows whose trials can be forked and are asked for; why not the others, counted."""
    kept: list[tuple[Path, TrialRow]] = []
    dropped: Counter = Counter()
    taken: dict[str, int] = defaultdict(int)
    for folder, row in sorted(rows, key=lambda r: (r[1].scenario_id, r[1].start, r[1].trial)):
        reason = _why_not(row, choice)
        if not reason and choice.trials and taken[row.scenario_id] >= choice.trials:
            reason = f"beyond the first {choice.trials} of its scenario (--trials)"
        if reason:
            dropped[reason] += 1
        else:
            taken[row.scenario_id] += 1
            kept.append((folder, row))
    return kept, dropped


def _why_not(row: TrialRow, choice: Choice) -> str:
    if not Outcome(row.outcome).valid or not row.steps:
        return f"outcome {row.outcome}"
    if FORK in row.options:
        return "is a fork itself"
    if row.interventions:
        return "has interventions, and so no single line of actions"
    if "realtime" in row.options:
        return "ran in real time, where the policy's delays decide"
    if row.run_seed is None:
        return "ran without a seed"
    if choice.of != "all" and row.success != (choice.of == "successes"):
        return f"not among the {choice.of} (--outcome)"
    return ""


def with_actions(
    rows: Iterable[tuple[Path, TrialRow]], scenarios: Mapping[str, Scenario]
) -> list[tuple[Scenario, LoggedTrial]]:
    """The trials with their actions, and their scenarios.

    Raises:
        ScenarioError: a trial's actions were not recorded, which names the option that does; or its
            scenario is another.
    """
    found = []
    for folder, row in rows:
        scenario = scenarios.get(row.scenario_id)
        if scenario is None or scenario.sha256() != row.scenario_sha256:
            what = "has another scenario of that id" if scenario else "has no such scenario"
            raise ScenarioError(
                f"trial {row.trial} of {row.scenario_id}: the set {what}. Name the set that was run with "
                "--scenarios (and --revision)"
            )
        found.append((scenario, LoggedTrial(row, read_actions(folder, row))))
    return found
