"""Writes trajectory datasets: LeRobotDatasets with exact actions, links to scenarios, and metadata of their
own."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover._version import __version__
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectories import (
    KINDS,
    LABEL,
    MAX_TRAJECTORIES_BYTES,
    SCHEMA_VERSION,
    TRAJECTORIES_FILE,
    ScenarioLink,
    TrajectoryRow,
    actions_sha256,
)
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.rollout import MAX_ACTION_MAGNITUDE
from lerobot_roborecover.scenario import Reset, Scenario, ScenarioError, Task
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_write

type Frame = Mapping[str, np.ndarray]
"""One time step by LeRobot feature name, as `episodes.to_frame` gives it."""


@dataclass(frozen=True)
class Trajectory:
    """One trajectory to be written."""

    task: Task
    driver: str
    actions: np.ndarray
    """(T, A) float64, as executed."""
    frames: Iterable[Frame]
    """T observations, one before each action, by LeRobot feature name (see `episodes.to_frame`)."""
    success: bool
    scenario: Scenario | None = None
    first_step: int = 0
    trial: int | None = None
    labels: Sequence[int] | None = None
    """(T,) 0 before the recovery point, 1 from it on; needed for the monitor."""
    reset: Reset | None = None
    """What puts the task in the episode's first state; needed for a rollout that can be replayed."""
    not_replayable: str = ""
    """Why it cannot be replayed exactly; empty where it can."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further columns by name, (T,) bool or float32."""


def split_by_scenario(
    ids: Iterable[str], sizes: Mapping[str, int], rng: np.random.Generator
) -> dict[str, str]:
    """Assigns scenario ids to splits at random; all frames of a scenario follow its id.

    Args:
        ids: scenario ids; repeats count once.
        sizes: number of scenarios by split; together as many as there are ids.
        rng: source of the draw.

    Raises:
        ScenarioError: the sizes do not add up.
    """
    unique = sorted(set(ids))
    if sum(sizes.values()) != len(unique):
        raise ScenarioError(
            f"splits {dict(sizes)} need {sum(sizes.values())} scenarios; there are {len(unique)}"
        )
    names = [name for name, size in sizes.items() for _ in range(size)]
    return {unique[i]: name for i, name in zip(rng.permutation(len(unique)), names, strict=True)}


def write_trajectories(
    root: str | os.PathLike[str],
    kind: str,
    trajectories: Iterable[Trajectory],
    *,
    fps: int,
    splits: Mapping[str, str] | None = None,
    description: str = "",
    license: str | None = None,
    also: Callable[[Path], object] = lambda folder: None,
) -> Path:
    """Writes a trajectory dataset; it appears as a whole, or not at all.

    Args:
        root: the dataset's folder; must be new or empty.
        kind: one of `KINDS`.
        trajectories: of one platform; drawn one at a time, so that a generator need not hold them all.
        fps: frame rate: the platform's control rate.
        splits: split by scenario id, where it is not the scenarios' own (`split_by_scenario`).
        description: free text.
        license: SPDX identifier, or None where none is decided.
        also: writes further files into the folder before it appears.

    Raises:
        ScenarioError: a trajectory does not fit the kind or the others, or there is none.
    """
    root = Path(root)
    if kind not in KINDS:
        raise ScenarioError(f"trajectory kind {kind!r} is not one of {', '.join(KINDS)}")
    with atomic_dir(root) as folder:
        links, rows, labels = _write_episodes(folder, kind, trajectories, fps, splits or {})
        write_metadata(folder, kind, links, rows, labels=labels, description=description, license=license)
        also(folder)
    return root


def _write_episodes(
    root: Path, kind: str, trajectories: Iterable[Trajectory], fps: int, splits: Mapping[str, str]
) -> tuple[list[ScenarioLink], list[TrajectoryRow], Counter]:
    from lerobot_roborecover.datasets.encoding import Episode, EpisodeWriter

    links: dict[str, ScenarioLink] = {}
    rows: list[TrajectoryRow] = []
    labels: Counter = Counter()
    writer: EpisodeWriter | None = None
    platform = ""
    with ExitStack() as stack:
        for number, trajectory in enumerate(trajectories):
            _check(kind, number, trajectory, platform or trajectory.task.platform)
            platform = trajectory.task.platform
            if writer is None:
                writer = stack.enter_context(EpisodeWriter(root, fps, platform))
            index = -1
            if trajectory.scenario is not None:
                scenario = trajectory.scenario
                link = ScenarioLink(scenario.id, scenario.sha256(), splits.get(scenario.id, scenario.split))
                if links.setdefault(scenario.id, link) != link:
                    raise ScenarioError(
                        f"trajectory {number}: another scenario than before has id {link.id!r}"
                    )
                index = list(links).index(scenario.id)
                labels.update((link.split, int(v)) for v in trajectory.labels or ())
            wrong = {k for k, v in trajectory.columns.items() if np.shape(v) != (len(trajectory.actions),)}
            if wrong:
                raise ScenarioError(f"trajectory {number}: column {min(wrong)} has not one value a step")
            writer.write(
                Episode(
                    f"trajectory {number}",
                    trajectory.actions,
                    trajectory.frames,
                    index,
                    trajectory.task.instruction,
                    {LABEL: np.asarray(trajectory.labels)}
                    if trajectory.labels is not None
                    else trajectory.columns,
                )
            )
            rows.append(_row(trajectory, index))
    if not rows:
        raise ScenarioError("there are no trajectories; a dataset needs at least one")
    return list(links.values()), rows, labels


def _row(trajectory: Trajectory, index: int) -> TrajectoryRow:
    return TrajectoryRow(
        task=asdict(trajectory.task),
        driver=trajectory.driver,
        steps=len(trajectory.actions),
        success=bool(trajectory.success),
        actions_sha256=actions_sha256(trajectory.actions),
        scenario_index=index,
        first_step=trajectory.first_step,
        trial=trajectory.trial,
        reset=None if trajectory.reset is None else trajectory.reset.as_json(),
        not_replayable=trajectory.not_replayable,
        provenance=dict(trajectory.provenance),
    )


def _check(kind: str, number: int, trajectory: Trajectory, platform: str) -> None:
    where = f"trajectory {number}"
    actions = np.asarray(trajectory.actions)
    widths = platform_named(trajectory.task.platform).action_widths
    if trajectory.task.platform != platform:
        raise ScenarioError(f"{where} is of {trajectory.task.platform}, the first of {platform}")
    if actions.dtype != np.float64 or actions.ndim != 2 or not len(actions) or actions.shape[1] not in widths:
        raise ScenarioError(
            f"{where}: actions must be (steps, {' or '.join(map(str, widths))}) float64 with at least one "
            f"step, got {actions.shape} of {actions.dtype}"
        )
    if not (np.abs(actions) <= MAX_ACTION_MAGNITUDE).all():
        raise ScenarioError(f"{where}: actions must be finite and at most {MAX_ACTION_MAGNITUDE:g}")
    if kind != "rollouts" and trajectory.scenario is None:
        raise ScenarioError(f"{where}: {kind} belong to a scenario; name it")
    if kind == "donors" and not trajectory.success:
        raise ScenarioError(f"{where}: a donor recovers the task; this one failed. Leave it out")
    if kind == "rollouts" and not (trajectory.not_replayable or trajectory.reset or trajectory.scenario):
        raise ScenarioError(f"{where}: a rollout has its reset, or says why it cannot be replayed exactly")
    labels = trajectory.labels
    if (kind == "monitor") != (labels is not None):
        raise ScenarioError(
            f"{where}: {kind} trajectories {'need' if kind == 'monitor' else 'have no'} labels"
        )
    if labels is not None:
        if len(labels) != len(actions) or not set(map(int, labels)) <= {0, 1}:
            raise ScenarioError(f"{where}: labels must be {len(actions)} values of 0 or 1")
        if any(a > b for a, b in pairwise(labels)):
            raise ScenarioError(f"{where}: labels go back from 1 to 0; they are 1 from the recovery point on")


def write_metadata(
    root: Path,
    kind: str,
    scenarios: Sequence[ScenarioLink],
    rows: Sequence[TrajectoryRow],
    *,
    labels: Mapping[tuple[str, int], int] | None = None,
    description: str = "",
    license: str | None = None,
) -> None:
    """Writes `meta/roborecover/trajectories.json` of a dataset whose episodes are there."""
    by_split = Counter(scenarios[r.scenario_index].split for r in rows if r.scenario_index >= 0)
    text = json.dumps(
        {
            "schema_version": SCHEMA_VERSION,
            "kind": kind,
            "platform": rows[0].task["platform"],
            "description": description,
            "license": license,
            "written_by": {"lerobot_env_roborecover": __version__},
            "counts": {
                "scenarios": len(scenarios),
                "trajectories": len(rows),
                "frames": sum(r.steps for r in rows),
                "split": dict(sorted(by_split.items())),
                "labels": {f"{split}:{label}": n for (split, label), n in sorted((labels or {}).items())},
            },
            "scenarios": [asdict(s) for s in scenarios],
            "trajectories": [asdict(r) for r in rows],
        },
        ensure_ascii=False,
        allow_nan=False,
    )
    if len(text.encode()) > MAX_TRAJECTORIES_BYTES:
        raise ScenarioError(
            f"{TRAJECTORIES_FILE} would exceed {MAX_TRAJECTORIES_BYTES} bytes; split the dataset"
        )
    atomic_write(root / FOLDER / TRAJECTORIES_FILE, text + "\n")
