"""Trials of one policy, from recovery points and from the same tasks' first states, and what each of their
steps showed.

Trials are run as `roborecover eval` runs them, and replayed to look at every step; both are kept in a working
folder, so that a rerun goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_roborecover.curation.policy_trials import env_config, run_trials
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.rendered_steps import RenderJob, replayed
from lerobot_roborecover.logs.row import LoggedTrial, TrialRow
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import Outcome, Scenario
from lerobot_roborecover.utils.atomic_io import atomic_file
from lerobot_roborecover.utils.options import internal, option

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig

STARTS = ("recovery", "initial")
_AT_ONCE = 256
"""Observations that go through the env preprocessor together."""


@dataclass(frozen=True)
class TrialSource:
    scenarios: str = option("", show_default=False)
    """Scenario set: folder, Hub id or shipped name."""
    policy: str = option("", metavar="CHECKPOINT", show_default=False, checkpoint=True)
    """Policy that acts in the trials, and is watched."""
    work: Path = internal(Path("outputs/detectors.work"))
    """Folder of trials and observations."""
    revision: str | None = option(None, name="scenarios-revision", metavar="REVISION")
    """Commit, tag or branch of the set on the Hub."""
    select: str = ""
    """Which scenarios, e.g. 'suite=hard; source=natural'."""
    env: Sequence[str] = option((), metavar="NAME=VALUE")
    """Option of the recovery env type, e.g. obs_type=state; may be given again."""
    trials: int = 1
    """Trials of each scenario, from each start."""
    run_seed: int = 1000
    """Run seed of the trials."""
    device: str | None = None
    """Where the policy and the detectors run."""
    workers: int = option(1, name="num-workers", old=("workers",))
    """Processes that replay and render."""
    slots: int = internal(0)

    def env_options(self, split: str, start: str) -> list[str]:
        """Options of the env type for trials of a split from a start."""
        found = [f"--split={split}", f"--start={start}", *(f"--{o}" for o in self.env)]
        found += [f"--select={self.select}"] if self.select else []
        return found + ([f"--revision={self.revision}"] if self.revision else [])

    def env_config(self, platform: str, split: str, start: str) -> RecoveryEnvConfig:
        return env_config(platform, self.scenarios, self.env_options(split, start))


@dataclass(frozen=True)
class ReplayedTrial(LoggedTrial):
    """A trial and what its steps showed: too large to be kept for trials that no detector watches."""

    scenario: Scenario
    control_hz: float
    observations: Mapping[str, np.ndarray]
    """(T, ...) by LeRobot key, as they leave the env preprocessor, of each step before its action, replayed
    ones first; pictures (T, 3, H, W) uint8."""

    @property
    def handoff(self) -> int:
        """Actions replayed before the policy took over."""
        return self.row.handoff_step

    @property
    def unit(self) -> str:
        """Label of what is independent: the first state, which scenarios share that branch off from it."""
        return self.scenario.first_state_sha256()

    @property
    def segments(self) -> tuple[slice, ...]:
        """Stretches that are watched on their own: what was replayed, and what the policy did. A detector
        begins anew at the handoff, as it does in use."""
        parts = (slice(0, self.handoff), slice(self.handoff, self.handoff + len(self.actions)))
        return tuple(p for p in parts if p.stop > p.start)


def replay_trials(
    source: TrialSource, split: str, env_batch: Any, progress: Callable[[str, int, int], None]
) -> tuple[list[ReplayedTrial], Counter]:
    """Runs and replays trials of a split from both starts.

    Args:
        source: which.
        split: of the set.
        env_batch: a policy host's, which makes LeRobot's batches of raw observations.
        progress: called with the step's name, how many are done, and of how many.

    Returns:
        Trials in the order of their scenarios, and how many were left out, by reason.

    Raises:
        OptionError, ScenarioError, SimulatorError, TrialLogError: what `roborecover eval` refuses.
    """
    scenarios = load_scenarios(source.scenarios, revision=source.revision, split=split, select=source.select)
    by_id = {s.id: s for s in scenarios}
    dropped: Counter = Counter()
    found = []
    for start in STARTS:
        config = source.env_config(scenarios.platform, split, start)
        options = config.run_spec().slot.options
        trials = run_trials(
            source.policy,
            config,
            source.work / f"{split}-{start}",
            trials=source.trials,
            seed=source.run_seed,
            device=source.device,
            slots=source.slots,
            on_row=lambda row, done, total, start=start: progress(f"{split}, {start}", done, total),
        )
        usable = []
        for trial in trials:
            if not Outcome(trial.row.outcome).valid or not len(trial.actions):
                dropped[f"{split}, {start}: {trial.row.outcome}"] += 1
            else:
                usable.append((by_id[trial.row.scenario_id], trial))
        found += look_at(
            usable, scenarios.platform, options, source, env_batch, f"{split}, {start}", progress
        )
    return found, dropped


def look_at(
    trials: Sequence[tuple[Scenario, LoggedTrial]],
    platform: str,
    options: Mapping[str, Any],
    source: TrialSource,
    env_batch: Any,
    what: str,
    progress: Callable[[str, int, int], None],
) -> list[ReplayedTrial]:
    """Replays trials, of which each step is kept in the working folder.

    Args:
        trials: with their scenarios.
        platform: of all of them.
        options: of the simulator.
        source: working folder and processes.
        env_batch: as of `replay_trials`.
        what: they are, in the words of the progress.
        progress: as of `replay_trials`.
    """
    one = make_simulator(platform, **options)
    control_hz = one.control_hz
    one.close()
    folder = source.work / "observations"
    files = [folder / f"{_key(s, t.row, options)}.npz" for s, t in trials]
    todo = [i for i, file in enumerate(files) if not file.is_file()]
    # Trials of a task together: a simulator compiles each task once.
    todo.sort(key=lambda i: (trials[i][0].task.suite, trials[i][0].task.name, trials[i][0].id))
    jobs = []
    for i in todo:
        scenario, trial = trials[i]
        first = trial.row.handoff_step
        jobs.append(RenderJob(scenario, trial.actions, np.arange(first + len(trial.actions)), first))
    done = len(trials) - len(todo)
    if jobs:
        for i, replay in zip(todo, replayed(jobs, options, source.workers), strict=True):
            if replay.succeeded != trials[i][1].row.success:
                raise RuntimeError(
                    f"{trials[i][0].id}: its replay ends otherwise than the trial; the simulator is not exact"
                )
            _keep(files[i], replay.observations, trials[i][0].task.instruction, env_batch)
            done += 1
            progress(f"{what}: looking", done, len(trials))
    made = []
    for (scenario, trial), file in zip(trials, files, strict=True):
        with np.load(file, allow_pickle=False) as saved:
            observations = {key: saved[key] for key in saved.files}
        made.append(ReplayedTrial(trial.row, trial.actions, scenario, control_hz, observations))
    return made


def _key(scenario: Scenario, row: TrialRow, options: Mapping[str, Any]) -> str:
    what = [scenario.sha256(), row.start, row.handoff_step, row.actions_sha256, dict(options)]
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()[:32]


def _keep(file: Path, raw: Sequence[Any], instruction: str, env_batch: Any) -> None:
    """Writes observations as LeRobot's batches hold them; pictures in bytes, which they came from."""
    import torch

    parts = []
    for at in range(0, len(raw), _AT_ONCE):
        chunk = raw[at : at + _AT_ONCE]
        batch = env_batch(chunk, [instruction] * len(chunk))
        parts.append({k: v for k, v in batch.items() if isinstance(v, torch.Tensor)})
    joined = {k: torch.cat([p[k] for p in parts]).cpu() for k in parts[0] if k.startswith("observation")}
    arrays = {
        k: (v * 255).round().to(torch.uint8).numpy() if v.ndim == 4 else v.float().numpy()
        for k, v in joined.items()
    }
    with atomic_file(file) as temporary, open(temporary, "wb") as out:
        np.savez_compressed(out, **arrays)
