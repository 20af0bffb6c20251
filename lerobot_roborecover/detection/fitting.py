"""Fits the detectors that learn: the distance from training states, and networks on the policy's features.

All are fitted to trials of the policy that acts, on scenarios that nothing is measured on; the states rather
to the policy's own training set, where that is given, and expected gains to forks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lerobot_roborecover.datasets.lerobot_folder import check_lerobot_folder, open_lerobot_folder
from lerobot_roborecover.detection.forked import ForkedTrial
from lerobot_roborecover.detection.scoring import PolicySignals
from lerobot_roborecover.detection.trials import ReplayedTrial
from lerobot_roborecover.policies.detectors.interface import DetectorError, DetectorNeeds
from lerobot_roborecover.policies.detectors.modeling_policy import (
    RoboRecoverPolicyFeaturesRewardModel,
    RoboRecoverRecoveryGainRewardModel,
)
from lerobot_roborecover.policies.detectors.modeling_states import (
    RoboRecoverStateDistanceRewardModel,
)
from lerobot_roborecover.scenario import ScenarioError


def fit_states(
    detector: RoboRecoverStateDistanceRewardModel, trials: Sequence[ReplayedTrial], training_data: Path | None
) -> str:
    """Fits it to a training set, else to clean rollouts that succeed.

    Args:
        detector: not fitted yet.
        trials: for where there is no training set.
        training_data: LeRobotDataset that the policy was trained on.

    Returns:
        What it was fitted to, in words.

    Raises:
        DetectorError: there are no such states.
    """
    keys = detector.config.key_list
    if training_data is not None:
        states, texts = training_states(training_data, keys)
        detector.fit(states, texts)
        return f"{len(texts)} frames of {training_data}"
    chosen = [t for t in trials if t.row.start == "initial" and t.row.success]
    if not chosen:
        raise DetectorError(
            "state_distance: no clean rollout of the fitting split succeeds. Give the policy's own training "
            "set with --training-data, or another --fit-split"
        )
    states = {
        k: torch.from_numpy(np.concatenate([t.observations[k][t.segments[-1]] for t in chosen])) for k in keys
    }
    texts = [t.scenario.task.instruction for t in chosen for _ in range(len(t.actions))]
    detector.fit(states, texts)
    _remember(detector, chosen)
    return f"{len(texts)} steps of {len(chosen)} successful clean rollouts"


def check_training_data(root: Path) -> None:
    """Refuses a folder that is no LeRobotDataset.

    Raises:
        DetectorError: naming it.
    """
    if not (root / "meta" / "info.json").is_file():
        raise DetectorError(
            f"--training-data {root}: no LeRobotDataset there (it has no meta/info.json). Give the folder of "
            "one, downloaded from the Hub or recorded"
        )
    try:
        check_lerobot_folder(root)
    except ScenarioError as err:
        raise DetectorError(f"--training-data: {err}") from None


def training_states(root: Path, keys: Sequence[str]) -> tuple[dict[str, torch.Tensor], list[str]]:
    """States of a LeRobotDataset, and the instruction of each.

    Args:
        root: folder of it.
        keys: columns.

    Raises:
        DetectorError: it lacks one.
    """
    check_training_data(root)
    dataset: Any = open_lerobot_folder(root)
    missing = [k for k in keys if k not in dataset.features]
    if missing:
        raise DetectorError(
            f"--training-data {root}: has no {missing[0]}, only "
            f"{sorted(k for k in dataset.features if k.startswith('observation'))}. Name others with "
            "state_distance,keys=..."
        )
    table = dataset.hf_dataset.with_format("numpy")
    states = {k: torch.from_numpy(np.stack(table[k][:]).astype(np.float32)) for k in keys}
    names = list(dataset.meta.tasks.index)
    return states, [names[int(i)] for i in np.asarray(table["task_index"][:]).reshape(-1)]


def fit_features(
    detector: RoboRecoverPolicyFeaturesRewardModel, trials: Sequence[ReplayedTrial], looks: PolicySignals
) -> str:
    """Fits it to whether the policy goes on by itself: 1 from the recovery point on in a trial that fails, 0
    in one that succeeds and in clean rollouts that do.

    Args:
        detector: not fitted yet.
        trials: of scenarios that nothing is measured on.
        looks: into the policy.

    Returns:
        What it was fitted to, in words.

    Raises:
        DetectorError: one of the labels is missing.
    """
    features, labels, used = [], [], []
    needs = DetectorNeeds(internals=True)
    for trial in trials:
        if trial.row.start == "initial" and not trial.row.success:
            continue
        steps = looks.of(trial, needs)[-1]
        rows = torch.stack([f for _, f in steps if f is not None])
        features.append(rows)
        labels.append(torch.full((len(rows),), float(not trial.row.success)))
        used.append(trial)
    if not used:
        raise DetectorError(
            "policy_features: the fitting split has no usable trial. Name another --fit-split"
        )
    detector.fit(torch.cat(features), torch.cat(labels))
    _remember(detector, used)
    counts: Mapping[str, int] = detector.config.labels
    return f"{counts['1']} steps of failing trials and {counts['0']} others, of {len(used)} trials"


def fit_gain(
    detector: RoboRecoverRecoveryGainRewardModel,
    forks: Sequence[tuple[ReplayedTrial, ForkedTrial]],
    looks: PolicySignals,
) -> str:
    """Fits the detector to the gains of interventions in forked trials.

    Args:
        detector: not fitted yet.
        forks: of trials of the policy that it watches, on scenarios that nothing is measured on.
        looks: into that policy.

    Returns:
        What it was fitted to, in words.

    Raises:
        DetectorError: the intervention rescued no trial.
    """
    features, gains = [], []
    for trial, forked in forks:
        steps = looks.of(trial, DetectorNeeds(internals=True))[-1]
        for step, gain in forked.gains.items():
            features.append(steps[step][1])
            gains.append(gain)
    detector.fit(torch.stack(features), torch.tensor(gains))
    _remember(detector, [trial for trial, _ in forks])
    counts: Mapping[str, int] = detector.config.labels
    return (
        f"{len(gains)} forks of {len(forks)} trials: {counts['rescued']} rescued, {counts['harmed']} harmed, "
        f"{counts['alike']} alike"
    )


def _remember(detector: Any, trials: Sequence[ReplayedTrial]) -> None:
    detector.trained_on = {
        "dataset": "trials of the policy that acts",
        "labels": dict(getattr(detector.config, "labels", {})),
        "scenarios": {t.scenario.id: t.scenario.sha256() for t in trials},
    }
