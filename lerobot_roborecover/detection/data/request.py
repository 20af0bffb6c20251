"""From policies and a scenario set to the monitor's datasets: what `roborecover detect data` does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_roborecover.curation.continuations import Continuation, from_rollouts, from_trials
from lerobot_roborecover.curation.policy_trials import env_config, read_trials, run_trials
from lerobot_roborecover.datasets import ScenarioSet, load_scenarios
from lerobot_roborecover.datasets.licenses import license_argument
from lerobot_roborecover.datasets.trajectories import read_trajectories
from lerobot_roborecover.detection.data.choice import DataOptions, choose
from lerobot_roborecover.detection.data.data import describe, write_monitor_data
from lerobot_roborecover.logs.fields import digest_of
from lerobot_roborecover.logs.row import LoggedTrial, TrialRow
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.scenario import Scenario, ScenarioError
from lerobot_roborecover.utils.options import option


@dataclass(frozen=True)
class MonitorRequest:
    """What is asked for."""

    scenarios: str
    """Scenario set: folder, Hub id or shipped name."""
    out: Path
    """Folder of the three datasets."""
    policies: Sequence[str] = option((), name="policy", metavar="CHECKPOINT")
    """Screening policy; give it again.

    Each continues every scenario once.
    """
    trials_from: Sequence[Path] = option((), metavar="DIR")
    """Folder of a policy's trials with their actions, e.g. SCREENED.trials/NAME: the first of each scenario
    is not run again; may be given again."""
    rollouts: Sequence[Path] = option((), metavar="DIR")
    """Recorded continuations: a trajectory dataset whose episodes belong to the scenarios."""
    revision: str | None = None
    """Commit, tag or branch of that set on the Hub."""
    split: str = "train"
    """Take this split of it only."""
    select: str = ""
    """Which scenarios, e.g. 'suite=libero_goal; source=natural'."""
    work: Path | None = None
    """Folder of the policies' trials, kept between runs (OUT.trials)."""
    choice: DataOptions = field(default_factory=DataOptions)
    run_seed: int = 1000
    """Run seed of the policies' trials."""
    device: str | None = None
    """Device of the policies."""
    workers: int = option(1, name="num-workers", old=("workers",))
    """Processes that replay and render."""
    license: str | None = option(None, parse=license_argument)
    """Licence by the Hub's identifier, of the frames; none is assumed."""
    env: Sequence[str] = option((), metavar="NAME=VALUE")
    """Option of the recovery env type, e.g. obs_type=state; may be given again."""
    frames: Sequence[str] = option((), metavar="NAME=VALUE")
    """The same for the rendered frames alone, where they differ from what the policies see."""


@dataclass(frozen=True)
class MonitorData:
    """What was made."""

    counts: dict[str, dict[str, int]]
    """IDs, trajectories, frames and labels by part."""
    dropped: Counter
    """Continuations left out, by reason."""


def make_monitor_data(request: MonitorRequest, progress: Callable[[str, int, int], None]) -> MonitorData:
    """Runs the policies, chooses frames, renders and writes them; goes on where it was interrupted.

    Args:
        request: what to make.
        progress: called with the step's name, how many are done, and of how many.

    Raises:
        OptionError, ScenarioError, SimulatorError, TrialLogError: what cannot be done, and the remedy.
    """
    if not (request.policies or request.trials_from or request.rollouts):
        raise ScenarioError(
            "no policy continues the scenarios: give --policy CHECKPOINT, --trials-from DIR or --rollouts DIR"
        )
    scenarios = load_scenarios(
        request.scenarios, revision=request.revision, split=request.split, select=request.select
    )
    which = [f"--split={request.split}"]
    which += [f"--select={request.select}"] if request.select else []
    which += [f"--revision={request.revision}"] if request.revision else []
    options = [*which, *(f"--{o}" for o in request.env)]
    dropped: Counter = Counter()
    continuations = _continuations(request, scenarios, options, dropped, progress)
    parts = choose(continuations, request.choice)
    rendering = [*options, *(f"--{o}" for o in request.frames)]
    spec = env_config(scenarios.platform, request.scenarios, rendering).run_spec()
    note = describe(
        request.choice,
        scenarios=request.scenarios,
        revision=scenarios.revision,
        split=request.split,
        drivers=sorted({c.driver for c in continuations}),
        simulator=dict(spec.decisive),
        dropped=dict(dropped),
    )
    counts = write_monitor_data(
        request.out, parts, simulator=spec.slot.options, workers=request.workers, note=note,
        license=request.license, on_trajectory=progress,
    )  # fmt: skip
    return MonitorData(counts, dropped)


def _continuations(
    request: MonitorRequest,
    scenarios: ScenarioSet,
    options: Sequence[str],
    dropped: Counter,
    progress: Callable[[str, int, int], None],
) -> list[Continuation]:
    by_id = {s.id: s for s in scenarios}
    work = request.work or request.out.with_name(f"{request.out.name}.trials")
    kept: dict[str, dict[str, LoggedTrial]] = {}
    for folder in request.trials_from:
        for trial in _first_trials(folder, by_id, dropped):
            kept.setdefault(_who(trial.row), {})[trial.row.scenario_id] = trial
    found = []
    for number, policy in enumerate(request.policies):
        trials = kept.pop(_asked(policy, request.device), {}) if kept else {}
        missing = by_id.keys() - trials.keys()
        if missing:
            ran = run_trials(
                policy,
                env_config(scenarios.platform, request.scenarios, options),
                work / f"{number}-{Path(policy).name or 'policy'}",
                only=missing,
                seed=request.run_seed,
                device=request.device,
                on_row=lambda row, done, total: progress(f"trials of {row.policy}", done, total),
            )
            trials |= {trial.row.scenario_id: trial for trial in ran}
        found += from_trials([trials[i] for i in sorted(trials)], by_id, dropped)
    for trials in kept.values():
        found += from_trials([trials[i] for i in sorted(trials)], by_id, dropped)
    for folder in request.rollouts:
        found += from_rollouts(read_trajectories(folder), by_id, dropped)
    return found


def _who(row: TrialRow) -> str:
    """A row's policy with its settings; the name alone where the row is of an earlier version."""
    return row.policy if row.policy_settings is None else f"{row.policy} {digest_of(row.policy_settings)}"


def _asked(policy: str, device: str | None) -> str:
    """The same of a checkpoint as it would be run here."""
    from lerobot_roborecover.evaluation.loading import policy_config

    facts = policy_metadata(policy_config(policy, device=device))
    return f"{facts.policy} {digest_of(facts.policy_settings)}"


def _first_trials(folder: Path, scenarios: Mapping[str, Scenario], dropped: Counter) -> list[LoggedTrial]:
    """A policy's first trial of each of the scenarios, of those that a folder has.

    Raises:
        ScenarioError: none of them is of these scenarios, or the actions are damaged.
        TrialLogError: the log is damaged.
    """
    found = []
    for trial in read_trials(folder):
        scenario = scenarios.get(trial.row.scenario_id)
        if trial.row.trial or scenario is None:
            continue
        if trial.row.scenario_sha256 != scenario.sha256():
            dropped["belongs to another version of its scenario"] += 1
        else:
            found.append(trial)
    if not found:
        raise ScenarioError(f"--trials-from {folder}: it has no trial of the {len(scenarios)} scenarios")
    return found
