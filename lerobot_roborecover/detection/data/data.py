"""Frames that teach a monitor: 0 strictly before the recovery point, 1 from it on.

One trajectory per screening policy and scenario (paper, "Benchmark-Guided Recovery Interventions"): the
prefix, then what the policy did from the recovery point. Frame i is the observation before action i, so that
frame t, t being the prefix's length, is the recovery point itself and has label 1. Frames are chosen before
anything is rendered, and only chosen ones are.

Written are three ordinary LeRobotDatasets, split by scenario: `train`, and two views of the held-out
scenarios, `validation_balanced` and `validation_natural` (appendix, "Monitor Training and Triggering").
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.datasets.rendered_steps import RenderJob, replayed
from lerobot_roborecover.datasets.trajectories import ScenarioLink, read_trajectories
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_trajectories
from lerobot_roborecover.detection.data.choice import BALANCED, NATURAL, TRAIN, Chosen, DataOptions, count
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_write

MANIFEST_FILE = "monitor_data.json"
SCHEMA_VERSION = 1
STEP = "roborecover.step"
"""(1,) int64: environment step of the frame since the task's reset; an episode may leave steps out."""


def write_monitor_data(
    out: Path,
    parts: Mapping[str, Sequence[Chosen]],
    *,
    simulator: Mapping[str, Any],
    workers: int = 1,
    note: Mapping[str, Any] | None = None,
    license: str | None = None,
    on_trajectory: Any = lambda part, done, total: None,
) -> dict[str, dict[str, int]]:
    """Renders and writes the parts, and their counts. A part with these very frames is kept.

    Args:
        out: folder of the three datasets.
        parts: what `choose` gave.
        simulator: keyword options of the simulators that render.
        workers: processes that replay and render.
        note: settings and sources, for the manifest.
        license: SPDX identifier of the frames.
        on_trajectory: called with the part, and how many trajectories are done of how many.

    Returns:
        IDs, frames, label 0, label 1 by part, as in the paper's Table of monitor data.

    Raises:
        ScenarioError: a scenario is in both splits, or `out` holds other frames.
    """
    check_disjoint(_links(parts.get(TRAIN, ())), _links([*parts[BALANCED], *parts[NATURAL]]), "this data")
    counts = {part: count(chosen) for part, chosen in parts.items()}
    digests = {part: _digest(chosen, simulator) for part, chosen in parts.items()}
    written = _read_digests(out)
    for part in parts:
        if (out / part).exists() and written.get(part) != digests[part]:
            raise ScenarioError(
                f"{out / part} holds other frames than these options choose; name another --out, or delete it"
            )
    out.mkdir(parents=True, exist_ok=True)
    for part, chosen in parts.items():
        if (out / part).exists():
            continue
        ordered = sorted(chosen, key=_order)
        fps, trajectories = _trajectories(part, ordered, simulator, workers, on_trajectory)
        split = "train" if part == TRAIN else "validation"
        write_trajectories(
            out / part,
            "monitor",
            trajectories,
            fps=fps,
            splits={c.continuation.scenario.id: split for c in ordered},
            description=f"Frames for a recovery monitor, part {part}: label 0 strictly before the recovery "
            "point, 1 from it on.",
            license=license,
        )
        written[part] = digests[part]
        manifest = {"schema_version": SCHEMA_VERSION, "counts": counts, "digests": written, **(note or {})}
        manifest["replays_that_end_otherwise"] = _differing(out, written)
        atomic_write(out / MANIFEST_FILE, json.dumps(manifest, indent=1, default=str) + "\n")
    return counts


def _digest(chosen: Sequence[Chosen], simulator: Mapping[str, Any]) -> str:
    """What decides a part's frames."""
    digest = hashlib.sha256(json.dumps(dict(simulator), sort_keys=True, default=str).encode())
    for c in sorted(chosen, key=_order):
        digest.update(f"{c.continuation.scenario.sha256()} {c.continuation.driver}".encode())
        digest.update(np.ascontiguousarray(c.continuation.actions).tobytes())
        digest.update(c.steps.astype("<i8").tobytes())
    return digest.hexdigest()


def _read_digests(out: Path) -> dict[str, str]:
    try:
        return dict(json.loads((out / MANIFEST_FILE).read_text(encoding="utf-8"))["digests"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _differing(out: Path, parts: Iterable[str]) -> list[str]:
    """Scenarios of trajectories whose replay did not end as they had ended."""
    found = set()
    for data in (read_trajectories(out / part) for part in parts):
        rows = [r for r in data.rows if r.provenance.get("replay_ends_as_recorded") is False]
        found |= {data.scenarios[r.scenario_index].id for r in rows}
    return sorted(found)


def check_disjoint(train: Iterable[ScenarioLink], validation: Iterable[ScenarioLink], what: str) -> None:
    """Refuses scenarios that are in both, by id or by content.

    Raises:
        ScenarioError: naming one.
    """
    validation = list(validation)
    for key in ("id", "sha256"):
        held_out = {getattr(link, key): link.id for link in validation}
        shared = sorted(held_out[v] for v in {getattr(link, key) for link in train} if v in held_out)
        if shared:
            raise ScenarioError(
                f"{what}: {len(shared)} scenarios are in training and in validation, e.g. {shared[0]!r}; a "
                "monitor is not measured on scenarios that it was trained on. Make the data again with "
                "`roborecover detect data`, or name another dataset"
            )


def _links(chosen: Iterable[Chosen]) -> list[ScenarioLink]:
    scenarios = {c.continuation.scenario.id: c.continuation.scenario for c in chosen}
    return [ScenarioLink(s.id, s.sha256(), "") for s in scenarios.values()]


def _order(chosen: Chosen) -> tuple:
    """Trajectories of a task together: a simulator compiles each task once."""
    c = chosen.continuation
    return c.scenario.task.suite, c.scenario.task.name, c.scenario.id, c.driver, c.trial


def _trajectories(
    part: str,
    ordered: Sequence[Chosen],
    simulator: Mapping[str, Any],
    workers: int,
    on_trajectory: Any,
) -> tuple[int, Iterator[Trajectory]]:
    """Frame rate, and the trajectories with their frames as they are rendered."""
    from lerobot_roborecover.datasets.episodes import to_frame
    from lerobot_roborecover.platforms import make_simulator

    platform = ordered[0].continuation.scenario.platform
    one = make_simulator(platform, **simulator)
    fps = round(one.control_hz)
    one.close()
    jobs = [RenderJob(c.continuation.scenario, c.continuation.actions, c.steps) for c in ordered]

    def made() -> Iterator[Trajectory]:
        for number, (chosen, replay) in enumerate(
            zip(ordered, replayed(jobs, simulator, workers), strict=True), 1
        ):
            c = chosen.continuation
            every = np.concatenate([c.scenario.prefix, c.actions.astype(np.float64)])
            frames = (
                {**to_frame(platform, o), STEP: np.array([s], dtype=np.int64)}
                for o, s in zip(replay.observations, chosen.steps, strict=True)
            )
            yield Trajectory(
                task=c.scenario.task,
                driver=c.driver,
                actions=every[chosen.steps],
                frames=frames,
                success=c.success,
                scenario=c.scenario,
                first_step=min(int(chosen.steps[0]), c.recovery_step),
                trial=c.trial,
                not_replayable="" if len(chosen.steps) == len(every) else "holds chosen steps only",
                labels=chosen.labels,
                provenance={
                    "recovery_step": c.recovery_step,
                    "steps": len(every),
                    "replay_ends_as_recorded": bool(replay.succeeded == c.success),
                },
            )
            on_trajectory(part, number, len(ordered))

    return fps, made()


def describe(options: DataOptions, **more: Any) -> dict[str, Any]:
    """Settings for the manifest."""
    return {"options": asdict(options), **more}
