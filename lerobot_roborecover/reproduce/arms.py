"""The two runs of a reproduction: each goes on where it was, and the second waits for what the first says."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lerobot_roborecover.analysis.first_states import with_first_states
from lerobot_roborecover.analysis.stats.agreement import AgreementVerdict, ScoreAgreement, agreement
from lerobot_roborecover.analysis.stats.intervals import Estimate
from lerobot_roborecover.analysis.summary import StartSummary, summarise
from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.arms import Arm, identity_of_run
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import read_log
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.registry import platform_of
from lerobot_roborecover.reproduce.hours import Costs, RunLength, run_length
from lerobot_roborecover.reproduce.scores import PublishedCheckpoint, PublishedScore
from lerobot_roborecover.scenario import ScenarioError, Start

INITIAL, RECOVERY = str(Start.INITIAL), str(Start.RECOVERY)
_TAKEN = ("--env.start", "--env.trial_log", "--output_dir", "--eval.n_episodes", "--config_path")
_SET = ("scenarios", "revision", "split", "select")


@dataclass(frozen=True)
class ReproductionPlan:
    """Which checkpoint is reproduced, on which scenarios, and how often."""

    checkpoint: PublishedCheckpoint
    out: Path
    trials: int = 5
    """Per scenario and arm."""
    arguments: tuple[str, ...] = ()
    """For `roborecover eval`, in both arms; they win over the configuration."""
    published: PublishedScore | None = None
    """What the initial arm is held against; None where nothing is published."""
    margin: float = 0.10
    anyway: bool = False
    """Run the recovery arm whatever the initial arm says."""
    costs: Costs = field(default_factory=Costs)

    def __post_init__(self):
        if self.trials < 1:
            raise OptionError(f"--trials={self.trials}: at least 1")
        if not 0 < self.margin < 1:
            raise OptionError(f"--margin={100 * self.margin:g}: points, above 0 and below 100")
        for argument in self.arguments:
            name, equals, _ = argument.partition("=")
            if name in _TAKEN:
                raise OptionError(f"{name} is set by this command itself")
            if not equals or not name.strip("-"):
                raise OptionError(f"--set {argument.lstrip('-')}: an option of roborecover eval, NAME=VALUE")

    def folder(self, start: str) -> Path:
        return self.out / start

    def log(self, start: str) -> Path:
        return self.folder(start) / "trials.jsonl"

    def argv(self, start: str) -> list[str]:
        """Arguments of `roborecover` that run an arm."""
        return [
            "eval", f"--config_path={self.checkpoint.config}", *self.checkpoint.arguments, *self.arguments,
            f"--env.start={start}", f"--env.trial_log={self.log(start)}",
            f"--eval.n_episodes={self.trials}", f"--output_dir={self.folder(start)}",
        ]  # fmt: skip

    def command_line(self, start: str) -> str:
        """The same to copy."""
        return shlex.join(["roborecover", *self.argv(start)])

    def option(self, name: str) -> str | None:
        """Value of an option `--NAME=VALUE`: the last one given, else the configuration's."""
        value = _dig(yaml.safe_load(self.checkpoint.config.read_text()) or {}, name.split("."))
        for argument in (*self.checkpoint.arguments, *self.arguments):
            key, _, given = argument.removeprefix("--").partition("=")
            if key == name:
                value = given
        return None if value is None else str(value)

    def identity(self, start: str) -> dict[str, Any]:
        """What all rows of an arm's log share, beside what its log's own keys say."""
        config = yaml.safe_load(self.checkpoint.config.read_text()) or {}
        arguments = [*self.checkpoint.arguments, *self.arguments]
        apart = {f"--env.{name}" for name in _SET} | {"--policy.path", "--policy.mapping"}
        named = [(a.partition("=")[0], a) for a in arguments]
        kept = "--runner.cross_cpu_deterministic", "--runner.portable"  # both names of one option
        pace = {name for name, _ in named if name.startswith("--runner.")} - set(kept)
        given = [a.replace(*kept) for name, a in named if name not in apart | pace]
        own = {name: self.option(f"policy.{name}") for name in ("path", "mapping")}
        env = {name: value for name, value in (config.get("env") or {}).items() if name not in _SET}
        return identity_of_run(
            platform_of(self.option("env.type") or ""),
            {**(config.get("policy") or {}), **own},
            start=start,
            arguments=given,
            env=env,
            seed=config.get("seed"),
            rename_map=config.get("rename_map"),
        )

    def scenarios(self) -> ScenarioSet:
        """The scenarios that both arms are run on.

        Raises:
            OptionError: nothing says which.
            ScenarioError: they cannot be loaded.
        """
        found = {name: self.option(f"env.{name}") or "" for name in _SET}
        kind = platform_of(self.option("env.type") or "")
        source, split = found["scenarios"], found["split"] or None
        own = platform_named(kind) if kind else None
        if own and own.default_scenarios:
            source, split = own.evaluated(source, split)
        if not source:
            raise OptionError(
                f"{self.checkpoint.config}: no scenario set. Give one: --scenarios FOLDER_OR_HUB_ID"
            )
        return load_scenarios(source, revision=found["revision"] or None, split=split, select=found["select"])

    def length(self, start: str, scenarios: ScenarioSet) -> RunLength:
        """What an arm should take at most."""
        executed = int(self.option("policy.n_action_steps") or 1)
        return run_length(list(scenarios), self.trials, executed, self.costs, replay=start == RECOVERY)


STOPS = (AgreementVerdict.LOWER, AgreementVerdict.UNMEASURED)
"""Standings of the initial arm after which the recovery arm is not run."""


@dataclass(frozen=True)
class ArmResult:
    """An arm that has been run."""

    start: str
    rows: tuple[TrialRow, ...]
    summary: StartSummary
    seconds: float
    """Seconds of wall time, over all its runs."""


@dataclass(frozen=True)
class ReproductionResult:
    plan: ReproductionPlan
    scenarios: int
    initial: ArmResult
    check: ScoreAgreement
    """The initial arm beside the published score."""
    makers: tuple[PublishedScore, ScoreAgreement] | None
    recovery: ArmResult | None
    """None where the initial arm is below what is published, or was not measured."""
    against_paper: ScoreAgreement | None
    """The recovery arm beside the paper's."""

    @property
    def confirmed(self) -> bool:
        """Whether the initial arm shows that the policy is set up as its score says."""
        return self.check.standing in (AgreementVerdict.AGREES, AgreementVerdict.HIGHER)


def run_arms(plan: ReproductionPlan, say: Callable[[str], None] = print) -> ReproductionResult:
    """Runs what is not done yet.

    Args:
        plan: what.
        say: takes progress lines; the runs themselves write to the terminal.

    Raises:
        ScenarioError: a run failed; the same command goes on where it was.
    """
    scenarios = plan.scenarios()
    initial = _run(plan, INITIAL, scenarios, say)
    rate = initial.summary.rate
    check = agreement(rate, plan.published.rate if plan.published else None, plan.margin)
    makers = plan.checkpoint.of_makers(list(scenarios))
    beside = None if makers is None else (makers, agreement(rate, makers.rate, plan.margin))
    recovery = None
    if check.standing not in STOPS or plan.anyway:
        recovery = _run(plan, RECOVERY, scenarios, say)
    against = None
    if recovery is not None:
        against = agreement(recovery.summary.rate, plan.checkpoint.recovery, plan.margin)
    return ReproductionResult(plan, len(scenarios), initial, check, beside, recovery, against)


def _run(plan: ReproductionPlan, start: str, scenarios: ScenarioSet, say: Callable[[str], None]) -> ArmResult:
    log, length = plan.log(start), plan.length(start, scenarios)
    # Checkpoints and scenario sets come from the Hub, unless the caller is offline.
    online = {"HF_HUB_OFFLINE": os.environ.get("HF_HUB_OFFLINE", "0")}
    arm = Arm(f"the {start} arm", log, plan.argv(start), plan.identity(start), environment=online)
    arm.run(
        say,
        f"{start}: {length.trials} trials, at most {length.hours:.2g} hours. {plan.command_line(start)}",
    )
    ids = {s.id for s in scenarios}
    (read,), _ = with_first_states([read_log(log)])
    rows = [r for r in read.rows if r.scenario_id in ids and r.trial < plan.trials]
    if len({row.config_hash for row in rows}) > 1:
        raise ScenarioError(
            f"{log} holds {start} trials under several settings, such as of two servers at one address; they "
            "are never averaged. Move it away, and run the same command again"
        )
    found = summarise([asdict(row) for row in rows], plan.trials).starts[Start(start)]
    return ArmResult(start, tuple(rows), found, arm.seconds())


def published_score(text: str) -> PublishedScore:
    """A published rate as it is given on the command line, in per cent: `94.2`, or `94.2,91.5,96.5`.

    Raises:
        OptionError: these are no such numbers.
    """
    try:
        numbers = [float(part) / 100 for part in text.split(",")]
        value, low, high = numbers if len(numbers) > 1 else (*numbers, float("nan"), float("nan"))
    except ValueError:
        raise OptionError(f"--published={text}: RATE or RATE,LOW,HIGH in per cent") from None
    if not 0 <= value <= 1 or (len(numbers) > 1 and not 0 <= low <= value <= high <= 1):
        raise OptionError(f"--published={text}: per cent, 0 <= LOW <= RATE <= HIGH <= 100")
    return PublishedScore(Estimate(value, low, high), "as given", "--published")


def _dig(config: Mapping[str, Any], keys: list[str]) -> Any:
    value: Any = config
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value
