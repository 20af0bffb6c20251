"""Actions executed after a recovery point, read from trials or from a trajectory dataset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_roborecover.datasets.trajectories import TrajectorySet
from lerobot_roborecover.logs.row import LoggedTrial
from lerobot_roborecover.scenario import Outcome, Scenario


@dataclass(frozen=True)
class Continuation:
    """Actions from a scenario's recovery point on, and how they ended. Apart from `LoggedTrial`: those of a
    trajectory dataset have no row."""

    scenario: Scenario
    driver: str
    actions: np.ndarray
    """(n, A), of the type in which they were executed."""
    success: bool
    trial: int = 0

    @property
    def recovery_step(self) -> int:
        """t: the first step of label 1."""
        return len(self.scenario.prefix)


def from_trials(
    trials: Iterable[LoggedTrial], scenarios: Mapping[str, Scenario], dropped: Counter
) -> list[Continuation]:
    """Continuations from recorded trials; what cannot be used is counted in `dropped` by its reason."""
    found = []
    for trial in trials:
        row = trial.row
        scenario = scenarios[row.scenario_id]
        if row.start != "recovery":
            dropped[f"starts at {row.start}, not at the recovery point"] += 1
        elif not Outcome(row.outcome).valid or not len(trial.actions):
            dropped[f"outcome {row.outcome}"] += 1
        elif row.interventions:
            dropped["has interventions, and so no single line of actions"] += 1
        else:
            found.append(Continuation(scenario, row.policy, trial.actions, row.success, row.trial))
    return found


def from_rollouts(
    rollouts: TrajectorySet, scenarios: Mapping[str, Scenario], dropped: Counter
) -> list[Continuation]:
    """Continuations from a trajectory dataset whose episodes belong to the scenarios.

    Args:
        rollouts: of kind `rollouts` or `donors`; an episode begins at its scenario's recovery point, or at
            its reset and repeats its prefix.
        scenarios: by id.
        dropped: counts what cannot be used, by its reason.
    """
    found = []
    for row, actions in zip(rollouts.rows, rollouts.actions(), strict=True):
        link = rollouts.scenarios[row.scenario_index] if row.scenario_index >= 0 else None
        scenario = scenarios.get(link.id) if link else None
        if link is None or scenario is None:
            dropped["belongs to no scenario of the set"] += 1
        elif scenario.sha256() != link.sha256:
            dropped["belongs to another version of its scenario"] += 1
        elif row.not_replayable:
            dropped[f"not replayable: {row.not_replayable}"] += 1
        else:
            t = len(scenario.prefix)
            if row.first_step == 0 and len(actions) > t and np.array_equal(actions[:t], scenario.prefix):
                actions = actions[t:]
            elif row.first_step != t:
                dropped["does not begin at the recovery point, nor repeat the prefix"] += 1
                continue
            found.append(Continuation(scenario, row.driver, actions, row.success, row.trial or 0))
    return found
