"""Screens a scenario dataset with policies and writes those scenarios that stay."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from lerobot_roborecover.curation.funnel import Decision, attrition_table, count_stages, read_decisions
from lerobot_roborecover.curation.screen.repeat import Repeats, draw_repeated, run_again
from lerobot_roborecover.curation.screen.runs import (
    PolicySpec,
    check_policies,
    forget_trials,
    run_policy,
    take_trials,
)
from lerobot_roborecover.curation.screen.screening import (
    Screened,
    ScreenRule,
    count_outcomes,
    provenance_of,
    screen,
)
from lerobot_roborecover.curation.screen.tables import (
    format_histogram,
    format_policies,
    format_settled,
    histogram,
)
from lerobot_roborecover.curation.split import UNSCREENED, draw_unscreened
from lerobot_roborecover.curation.stage_dataset import write_stage
from lerobot_roborecover.datasets import ScenarioSet, load_scenarios, read_scenarios
from lerobot_roborecover.datasets.frame_files import FrameStore
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.atomic_io import check_new
from lerobot_roborecover.utils.options import internal, option, parse_shard
from lerobot_roborecover.utils.text import next_command, pluralize
from lerobot_roborecover.workers.backend import LOCAL, Backend

SCREENING_FILE = "screening.json"
SNAPSHOTS_FOLDER = ".snapshots"
"""In the trials' folder, until the screening has come to its end: handoffs that need no replay again."""


def _outcomes(text: str) -> tuple[str, ...]:
    return tuple(outcome for outcome in text.split(",") if outcome)


@dataclass(frozen=True, kw_only=True)
class ScreenRequest:
    """What to screen, with which policies and how."""

    dataset: str = option(positional=True)
    """Scenario set: folder, Hub id or shipped name."""
    policies: Sequence[PolicySpec] = internal(())
    """Those that screen."""
    out: Path
    """Folder of the new dataset; new or empty."""
    rule: ScreenRule = field(default_factory=ScreenRule)
    deterministic: Sequence[str] = option((), metavar="NAME")
    """This policy does the same in every trial: run one of each scenario, and count it as all; may be given
    again."""
    trials_folder: Path | None = option(None, metavar="DIR")
    """Trials, kept between runs (OUT.trials)."""
    trials_from: Sequence[Path] = option((), metavar="DIR")
    """A trials folder of another machine, to be taken over first; may be given again."""
    shard: str = option("", metavar="K/N")
    """Run the trials of part K of N only, K from 0, and write no dataset."""
    retry: Sequence[str] = option((), text="", metavar="OUTCOMES", parse=_outcomes)
    """Run invalid trials of these outcomes again, e.g. policy_error,timeout."""
    unscreened: int = option(0, metavar="N")
    """So many scenarios, drawn at random, stay whatever the trials say, as split `unscreened`: what screening
    does to ranks is seen on them."""
    repeat: float = option(0.0, metavar="SHARE")
    """Run the trials of this share of the scenarios once more, their prefixes replayed again, and list those
    that end otherwise (in `TRIALS.again`; 0.05 is one in twenty)."""
    run_seed: int = 1000
    """Run seed of the trials, and seed of these draws."""
    device: str | None = None
    """Device of the policies."""
    slots: int = option(0, name="num-workers", old=("slots",))
    """Simulators at once (one per core, or CPU of a cluster)."""
    workplace: Backend = LOCAL
    """Where trials are run."""
    replicas: int = option(0, metavar="N")
    """Copies of a policy on the cluster (one per GPU, or one on the CPU)."""
    max_batch: int = 1
    """Observations per inference, at most ({default}); above 1 the last bits of actions, and with them some
    outcomes, depend on the other observations."""
    env: Sequence[str] = internal(())
    """`name=value` options of the recovery env type, for all policies."""

    @property
    def trials(self) -> Path:
        return self.trials_folder or self.out.with_name(f"{self.out.name}.trials")

    def check(self) -> None:
        """Checks what can be checked without scenarios, but for the rule, which `rule.check` does.

        Raises:
            OptionError: policies cannot be distinguished, or an option is not one for screening.
        """
        self.workplace.check()
        check_policies(self.policies)
        if self.shard:
            parse_shard(self.shard, "--shard")
        if not 0 <= self.repeat <= 1:
            raise OptionError(f"--repeat {self.repeat}: a share of the scenarios, from 0 to 1")
        unknown = set(self.deterministic) - {p.name for p in self.policies}
        if unknown:
            raise OptionError(
                f"--deterministic {' '.join(sorted(unknown))}: not among the policies "
                f"{', '.join(p.name for p in self.policies)}"
            )
        for text in (*self.env, *(o for p in self.policies for o in p.env)):
            if text.split("=")[0] in ("shard", "trial_log", "scenarios", "start", "split", "select"):
                raise OptionError(
                    f"--env {text}: screening settles this itself"
                    + ("; use --shard" if text.startswith("shard") else "")
                )


@dataclass(frozen=True)
class Screening:
    found: list[Screened]
    """Empty where only a shard's trials were run."""
    rows: Mapping[str, Sequence[TrialRow]]
    """Rows by the policy's name."""
    repeats: Repeats | None = None
    """None where nothing was run twice."""


def screen_dataset(
    request: ScreenRequest,
    progress: Callable[[str, int, int], None] = lambda policy, done, total: None,
) -> Screening:
    """Runs the trials that are missing, judges, and writes.

    Args:
        request: what and how.
        progress: called with each finished trial: the policy's name, and how many are done of how many.

    Raises:
        OptionError, ScenarioError: the request makes no sense, or no scenario stays.
        SimulatorError, TrialLogError: what `roborecover eval` refuses.
    """
    request.check()
    request.rule.check(len(request.policies))
    if not request.shard:
        check_new(request.out)
    scenarios = load_scenarios(request.dataset)
    sample = draw_unscreened(list(scenarios), request.unscreened, request.run_seed)
    for policy in request.policies:
        folder = request.trials / policy.name
        for other in request.trials_from:
            if (other / policy.name).is_dir():
                take_trials(other / policy.name, folder)
        if request.retry:
            forget_trials(folder, request.retry)
    snapshots = request.trials.resolve() / SNAPSHOTS_FOLDER
    rows = _trials(request, scenarios, sample, snapshots, progress)
    shutil.rmtree(snapshots, ignore_errors=True)
    if request.shard:
        return Screening([], rows)
    found = screen(scenarios, rows, request.rule, request.deterministic, sample)
    repeats = _repeats(request, scenarios, rows, progress) if request.repeat else None
    source = Path(request.dataset).expanduser()
    decisions = [_decision(s) for s in found]
    write_stage(
        request.out,
        source if source.is_dir() else None,
        [
            _screened(s, request.run_seed)
            for s, decision in zip(found, decisions, strict=True)
            if decision.verdict == "kept"
        ],
        decisions,
        (SCREENING_FILE, _record(found, request, rows, sample, repeats)),
        scenarios.manifest,
    )
    return Screening(found, rows, repeats)


def _repeats(
    request: ScreenRequest,
    scenarios: ScenarioSet,
    rows: Mapping[str, Sequence[TrialRow]],
    progress: Callable[[str, int, int], None],
) -> Repeats:
    policies = {p.name: p for p in request.policies}
    folder = request.trials.with_name(f"{request.trials.name}.again")

    def run(name: str, trials: int, only: set[str]) -> list[TrialRow]:
        found = run_policy(
            policies[name], request.dataset, scenarios.platform, folder, trials=trials, only=only,
            run_seed=request.run_seed, env=request.env, device=request.device, slots=request.slots,
            max_batch=request.max_batch, replicas=request.replicas, workplace=request.workplace,
            on_row=lambda row, done, total: progress(f"{name} again", done, total),
        )  # fmt: skip
        return [trial.row for trial in found]

    return run_again(rows, draw_repeated([s.id for s in scenarios], request.repeat, request.run_seed), run)


def _trials(
    request: ScreenRequest,
    scenarios: ScenarioSet,
    sample: Collection[str],
    snapshots: Path,
    progress: Callable[[str, int, int], None],
) -> dict[str, list[TrialRow]]:
    """Every trial that the verdicts need, by the policy's name.

    Each scenario's prefix is replayed for the first of them; on one machine the others
    go on from its handoff.

    A curtailed screening takes one policy after the other, those that need one trial only first, and as many
    trials of each as may settle some verdict, of the scenarios that are open then. Scenarios that lack
    successes get trials of the first policy first, those that lack failures of the last.
    """
    rule, started = request.rule, False
    rows: dict[str, dict[tuple, TrialRow]] = {p.name: {} for p in request.policies}

    def run(policy: PolicySpec, trials: int, only: Collection[str] | None) -> None:
        nonlocal started
        found = run_policy(
            policy, request.dataset, scenarios.platform, request.trials, trials=trials, only=only,
            run_seed=request.run_seed, env=request.env, shard=request.shard, device=request.device,
            slots=request.slots, max_batch=request.max_batch, replicas=request.replicas,
            snapshots=None if request.workplace.on_cluster else snapshots,
            workplace=replace(request.workplace, fits=started),
            on_row=lambda row, done, total: progress(policy.name, done, total),
        )  # fmt: skip
        started = True
        rows[policy.name] |= {t.row.key(): t.row for t in found}

    def undecided() -> list[Screened]:
        so_far = {name: list(of.values()) for name, of in rows.items()}
        counted = count_outcomes(scenarios, so_far, rule, request.deterministic, sample)
        return [s for s in counted if not s.settled]

    def lacking() -> list[Screened]:
        return [s for s in undecided() if s.successes < rule.bounds(len(rows))[0]]

    def settle(policy: PolicySpec, find_open: Callable[[], list[Screened]]) -> None:
        most = 1 if policy.name in request.deterministic else rule.trials
        trials = 0
        while trials < most and (left := find_open()):
            trials = min(trials + min(s.soonest for s in left), most)
            run(policy, trials, {s.scenario.id for s in left})

    certain = [p for p in request.policies if p.name in request.deterministic]
    others = [p for p in request.policies if p.name not in request.deterministic]
    if rule.curtail:
        for policy in certain:
            settle(policy, undecided)
        for policy in others:
            settle(policy, lacking)
        for policy in reversed(others):
            settle(policy, undecided)
    else:
        for policy in request.policies:
            run(policy, 1 if policy in certain else rule.trials, None)
    return {name: list(of.values()) for name, of in rows.items()}


def describe(request: ScreenRequest, made: Screening) -> str:
    """Returns the result of a screening as text: the tables, the funnel, and the command that follows."""
    if request.shard:
        return f"part {request.shard}: trials in {request.trials}; join with --trials-from {request.trials}"
    rule, policies = request.rule, len(request.policies)
    low, high = rule.check(policies)
    found = _by_verdict(made.found)
    kept = sum(s.decision.verdict == "kept" for s in found)
    head = (
        f"{kept} of {pluralize(len(found), 'scenario')} in {request.out}: {low} to {high} successes of "
        f"{policies * rule.trials} ({pluralize(policies, 'policy')} x {pluralize(rule.trials, 'trial')})"
    )
    if unscreened := len(made.found) - len(found):
        head += f"; beside them {pluralize(unscreened, 'scenario')} drawn at random, unscreened"
    tables = (
        format_policies(found),
        format_settled(found) if rule.curtail else format_histogram(found, rule),
        attrition_table(count_stages(read_decisions(request.out))),
    )
    repeats = () if made.repeats is None else (str(made.repeats),)
    return "\n\n".join((head, *repeats, *tables, next_command(validate_next(request.out, request.trials))))


def validate_next(out: Path, trials: Path) -> list[str]:
    """Arguments of the `validate` that follows, which needs the original frames of every scenario: those that
    the dataset holds, or else the candidates'."""
    argv = ["curate", "validate", str(out), "--trials-folder", str(trials)]
    store = FrameStore(out)
    if any(s.id not in store for s in read_scenarios(out)):
        argv += ["--candidates", "CANDIDATES"]
    return [*argv, "--out", "VALIDATED"]


def _by_verdict(found: Sequence[Screened]) -> list[Screened]:
    """Those that stay or not by their trials."""
    return [s for s in found if not s.unscreened]


def _decision(found: Screened) -> Decision:
    if not found.unscreened:
        return found.decision
    return replace(found.decision, verdict="kept", reason="", by="drawn at random before screening")


def _screened(found: Screened, run_seed: int) -> Scenario:
    scenario, note = found.scenario, provenance_of(found, run_seed)
    split = UNSCREENED if found.unscreened else scenario.split
    return replace(scenario, split=split, provenance={**scenario.provenance, "screening": note})


def _record(
    found: Sequence[Screened],
    request: ScreenRequest,
    rows: Mapping[str, Sequence[TrialRow]],
    sample: Collection[str],
    repeats: Repeats | None,
) -> dict:
    low, high = request.rule.check(len(request.policies))
    return {
        "rule": {**asdict(request.rule), "successes": [low, high]},
        "deterministic": sorted(request.deterministic),
        "run_seed": request.run_seed,
        **({UNSCREENED: sorted(sample)} if sample else {}),
        **({} if repeats is None else {"repeated": repeats.record}),
        "env": list(request.env),
        "policies": [
            {
                "name": p.name,
                "policy": sorted({r.policy for r in rows[p.name]}),
                "options": list(p.options),
                "env": list(p.env),
                "rename_map": dict(p.rename_map),
            }
            for p in request.policies
        ],
        **({} if request.rule.curtail else {"scenarios_by_successes": histogram(_by_verdict(found))}),
    }
