"""Asks a monitor about every frame of a labelled dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from lerobot_roborecover.analysis.stats.monitor import MonitorFrames
from lerobot_roborecover.datasets.lerobot_folder import open_lerobot_folder
from lerobot_roborecover.datasets.trajectories import LABEL, ScenarioLink, TrajectorySet, read_trajectories
from lerobot_roborecover.detection.data.data import STEP, check_disjoint
from lerobot_roborecover.policies.detectors.monitor.base import MonitorRewardModel, choose_features
from lerobot_roborecover.scenario import ScenarioError


def check_held_out(monitor: MonitorRewardModel, data: TrajectorySet) -> None:
    """Refuses a dataset that shares scenarios with the monitor's training set.

    Raises:
        ScenarioError: naming one.
    """
    trained = [ScenarioLink(i, sha, "") for i, sha in monitor.trained_on.get("scenarios", {}).items()]
    check_disjoint(trained, data.scenarios, str(data.root))


def judge_dataset(
    monitor: MonitorRewardModel,
    root: Path,
    *,
    num_workers: int = 0,
    on_training_scenarios: bool = False,
    on_batch: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[MonitorFrames, TrajectorySet]:
    """Judges all frames, exactly as the composite policy would ask.

    Args:
        monitor: loaded with `loading.load_monitor`.
        root: folder of a dataset that `roborecover detect data` made.
        num_workers: processes that read frames.
        on_training_scenarios: measure also what the monitor was trained on.
        on_batch: called with how many frames are done of how many.

    Raises:
        ScenarioError: it is not such a dataset, or holds scenarios that the monitor was trained on.
        DetectorError: it lacks what the monitor reads.
    """
    import torch

    found = read_trajectories(root)
    if found.kind != "monitor":
        raise ScenarioError(
            f"{root} holds {found.kind}; a monitor is measured on `roborecover detect data`'s frames"
        )
    if not on_training_scenarios:
        check_held_out(monitor, found)
    dataset = open_lerobot_folder(root)
    choose_features(monitor.config, dataset.features)
    loader = torch.utils.data.DataLoader(
        dataset, batch_size=min(monitor.max_batch, 256), num_workers=num_workers
    )
    columns: dict[str, list[np.ndarray]] = {n: [] for n in ("episode", "step", "label", "score", "decision")}
    done = 0
    for batch in loader:
        verdicts = monitor.judge_batch(batch)
        steps = batch[STEP] if STEP in batch else batch["frame_index"]
        columns["episode"].append(batch["episode_index"].numpy().reshape(-1))
        columns["step"].append(steps.numpy().reshape(-1).astype(np.int64))
        columns["label"].append(batch[LABEL].numpy().reshape(-1).astype(np.int64))
        columns["score"].append(np.asarray(verdicts.scores, dtype=np.float64))
        columns["decision"].append(np.asarray(verdicts.triggers, dtype=bool))
        done += len(verdicts.scores)
        on_batch(done, len(dataset))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    episode = joined["episode"]
    links = [found.scenarios[row.scenario_index].id for row in found.rows]
    starts = _recovery_steps(found, joined)
    return (
        MonitorFrames(
            scenario=np.array([links[e] for e in episode]),
            recovery_step=np.array([starts[e] for e in episode], dtype=np.int64),
            **joined,
        ),
        found,
    )


def _recovery_steps(found: TrajectorySet, columns: dict[str, np.ndarray]) -> list[int]:
    """First step of label 1 by episode: as recorded, else the first one seen."""
    starts = []
    for number, row in enumerate(found.rows):
        recorded = row.provenance.get("recovery_step")
        if type(recorded) is not int or recorded < 0:
            mine = (columns["episode"] == number) & (columns["label"] == 1)
            recorded = int(columns["step"][mine].min()) if mine.any() else np.iinfo(np.int64).max
        starts.append(recorded)
    return starts
