"""Forked trials with the gain of the intervention at each fork: training data of `recovery_gain`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.analysis.stats.fork_gain import ForkPair, fork_gains
from lerobot_roborecover.curation.policy_trials import TRIALS_FILE
from lerobot_roborecover.datasets import load_scenarios
from lerobot_roborecover.datasets.trajectories import ScenarioLink
from lerobot_roborecover.detection.trials import ReplayedTrial, TrialSource, look_at
from lerobot_roborecover.logs.fields import digest_of
from lerobot_roborecover.logs.row import ACTIONS_FOLDER, LoggedTrial, TrialRow, read_actions
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.detectors.interface import DetectorError
from lerobot_roborecover.scenario import ScenarioError


@dataclass(frozen=True)
class ForkedTrial:
    """One trial, continued from several of its steps. Apart from `TrialRow`: each gain is of several rows."""

    row: TrialRow
    """Row of its last continuation, which up to the last fork is the trial itself."""
    gains: Mapping[int, float]
    """By step from the handoff: success with an intervention, less success when the policy goes on; the mean
    over random streams."""


@dataclass(frozen=True)
class ForkLog:
    """What a log of `roborecover detect fork` says of one arm."""

    path: Path
    arm: str
    trials: tuple[ForkedTrial, ...]

    @property
    def links(self) -> list[ScenarioLink]:
        """Scenarios of the trials."""
        shas = {t.row.scenario_id: t.row.scenario_sha256 for t in self.trials}
        return [ScenarioLink(i, sha, "") for i, sha in shas.items()]


def read_forks(log: Path, policy: str, arm: str = "") -> ForkLog:
    """Reads a log of forks.

    Args:
        log: the file, or the folder that `roborecover detect fork --out` filled.
        policy: identity of the policy whose trials must have been forked (`policy_metadata`).
        arm: label of the arm, or how it begins; empty where the log has one.

    Raises:
        DetectorError: it is not there, is of another policy, or the arm is not one of its.
        ScenarioError, TrialLogError: it has no forks, or is damaged.
    """
    path = log / TRIALS_FILE if log.is_dir() else log
    if not path.is_file():
        raise DetectorError(f"--forks {log}: no log there; `roborecover detect fork --out {log}` writes one")
    gains = fork_gains(read_trial_log(path))
    arms = [a for a in gains.arms if a == arm] or [a for a in gains.arms if a.startswith(arm)]
    if len(arms) != 1:
        raise DetectorError(
            f"--forks {log}: {'no' if not arms else 'more than one'} arm begins with {arm!r}; it has "
            f"{', '.join(gains.arms)}. Name one: recovery_gain,arm=..."
        )
    pairs = [p for p in gains.pairs if p.note.arm == arms[0]]
    others = sorted({p.continued.policy for p in pairs} - {policy})
    if others:
        raise DetectorError(
            f"--forks {log}: forks of {others[0]}, and the policy that is watched is {policy}. Fork its own "
            "trials"
        )
    settings = {digest_of(p.continued.policy_settings) for p in pairs}
    if len(settings) > 1:
        raise DetectorError(
            f"--forks {log}: forks of {policy} under {len(settings)} settings of its own, which would be "
            "mixed. Keep one in a log"
        )
    by_trial: dict[tuple, list[ForkPair]] = defaultdict(list)
    for p in pairs:
        by_trial[p.row.scenario_id, p.row.start, p.row.trial, p.note.of].append(p)
    return ForkLog(path, arms[0], tuple(map(_forked, by_trial.values())))


def see_forks(
    log: ForkLog, source: TrialSource, env_batch: Any, progress: Callable[[str, int, int], None]
) -> list[tuple[ReplayedTrial, ForkedTrial]]:
    """Replays forked trials to see what they showed.

    Args:
        log: of the watched policy.
        source: whose scenarios, observations and working folder they share.
        env_batch: as of `replay_trials`.
        progress: called with the step's name, how many are done, and of how many.

    Raises:
        ScenarioError: scenarios are not those of the set, or actions are missing.
    """
    scenarios = load_scenarios(source.scenarios, revision=source.revision)
    by_id = {s.id: s for s in scenarios}
    for link in log.links:
        if link.id not in by_id or by_id[link.id].sha256() != link.sha256:
            raise ScenarioError(
                f"--forks {log.path}: {link.id} is not in {source.scenarios} as it was forked; fork trials "
                "of this set"
            )
    found: list[tuple[ReplayedTrial, ForkedTrial]] = []
    for start in sorted({t.row.start for t in log.trials}):
        mine = [t for t in log.trials if t.row.start == start]
        options = source.env_config(scenarios.platform, "", start).run_spec().slot.options
        folder = log.path.with_name(ACTIONS_FOLDER)
        played = [(by_id[t.row.scenario_id], LoggedTrial(t.row, read_actions(folder, t.row))) for t in mine]
        seen = look_at(played, scenarios.platform, options, source, env_batch, f"forks, {start}", progress)
        found += zip(seen, mine, strict=True)
    return found


def _forked(pairs: Sequence[ForkPair]) -> ForkedTrial:
    by_step: dict[int, list[float]] = defaultdict(list)
    for p in pairs:
        by_step[p.note.step].append(p.difference)
    last = max(pairs, key=lambda p: p.note.step)
    return ForkedTrial(last.continued, {step: float(np.mean(d)) for step, d in sorted(by_step.items())})
