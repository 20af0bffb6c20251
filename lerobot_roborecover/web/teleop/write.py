"""From saved recordings to the candidate dataset: replayed, checked, rendered in parts, joined.

Each part holds a few recordings and is a candidate dataset of its own; a run that was stopped goes on with
the parts that are missing. The dataset itself is put together anew from all parts and takes its place
at once.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.annotation.votes import votes_folder
from lerobot_roborecover.curation.candidates import Candidate, Suggestion
from lerobot_roborecover.curation.candidates_write import Recording, merge_candidates, write_candidates
from lerobot_roborecover.curation.funnel import DECISIONS_FILE, read_decisions
from lerobot_roborecover.curation.video_settings import VideoSettings
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectory_write import Trajectory
from lerobot_roborecover.platforms import Simulator, make_simulator
from lerobot_roborecover.platforms.simulator import iter_steps
from lerobot_roborecover.replay.recorder import UNPERTURBED, Steps
from lerobot_roborecover.scenario import HANDOFF_TOLERANCE_M, ScenarioError, Source
from lerobot_roborecover.utils.atomic_io import atomic_dir
from lerobot_roborecover.utils.text import pluralize
from lerobot_roborecover.web.teleop.store import Recorded, Store, lacking, read_recording

PER_PART = 10
"""Recordings of a part: so many are rendered again, at most, after an interruption."""


def recordings_folder(dataset: Path) -> Path:
    """Where the recordings of a dataset lie: beside it, since a dataset is written as a whole."""
    return dataset.with_name(f"{dataset.name}.recordings")


def check_open(dataset: Path) -> None:
    """Checks that recordings may still be added to a dataset.

    Raises:
        ScenarioError: it is something else, or work on it has begun.
    """
    if not dataset.exists() or not any(dataset.iterdir()):
        return
    if not recordings_folder(dataset).is_dir():
        raise ScenarioError(f"{dataset} was not made by `roborecover curate teleop`; name a new folder")
    later = {d.stage for d in read_decisions(dataset)} - {"collect"} if _has_decisions(dataset) else set()
    votes = votes_folder(dataset, None)
    if later or (votes.is_dir() and any(votes.iterdir())):
        raise ScenarioError(
            f"{dataset} is being worked on ({', '.join(sorted(later)) or 'annotated'}); recordings cannot be "
            "added any more. Name a new folder; `merge_candidates` joins datasets"
        )


def _has_decisions(dataset: Path) -> bool:
    return (dataset / FOLDER / DECISIONS_FILE).exists()


def write_dataset(
    dataset: Path,
    store: Store,
    platform: str,
    options: Mapping[str, Any],
    size: int | None,
    say: Callable[[str], None],
    frame_stride: int = 1,
) -> bool:
    """Renders the recordings that no part holds yet, and puts the dataset together.

    Args:
        dataset: its folder.
        store: the recordings.
        platform: their simulator.
        options: of the simulator, beside its pictures.
        size: rows and columns of the pictures; None for the platform's own, 0 for none.
        say: called with the progress.
        frame_stride: steps from one picture to the next; the last one stands until then.

    Returns:
        Whether there is anything.

    Raises:
        ScenarioError: a recording is damaged, or the dataset is being worked on.
        SimulatorError: the simulator cannot be had, or cannot render.
    """
    from lerobot_roborecover.web.teleop.serve import view_options

    check_open(dataset)
    paths = store.paths()
    if not paths:
        say("nothing was recorded")
        return False
    groups = [paths[i : i + PER_PART] for i in range(0, len(paths), PER_PART)]
    parts = [_part_of(store.folder, group) for group in groups]
    missing = [(group, part) for group, part in zip(groups, parts, strict=True) if not part.is_dir()]
    if not missing and dataset.exists():
        say(f"{dataset} holds what was recorded: {pluralize(len(paths), 'recording')}")
        return True
    if missing:
        seen = {**options, **view_options(platform, size)}
        simulator = make_simulator(platform, **seen)
        # Numbers cost nothing, and none may stand for another step's.
        video = VideoSettings(1 if size == 0 else frame_stride, seen)
        try:
            done = len(paths) - sum(len(group) for group, _ in missing)
            for group, part in missing:
                recordings = [read_recording(path) for path in group]
                say(f"rendering {done + 1} to {done + len(group)} of {len(paths)}")
                _write_part(part, recordings, simulator, video)
                done += len(group)
        finally:
            simulator.close()
    _join(dataset, parts)
    for old in set(store.folder.glob("part-*")) - set(parts):
        shutil.rmtree(old)
    say(f"{dataset}: {pluralize(len(paths), 'candidate')}")
    return True


def _part_of(folder: Path, group: list[Path]) -> Path:
    first, last = (path.stem.removeprefix("recording-") for path in (group[0], group[-1]))
    return folder / f"part-{first}-{last}"


def _write_part(part: Path, recordings: list[Recorded], simulator: Simulator, video: VideoSettings) -> None:
    versions = simulator.fingerprint()
    for recorded in recordings:
        if dict(recorded.versions) != versions:
            raise ScenarioError(
                f"{recorded.id} was recorded with {dict(recorded.versions)}, and this is {versions}: what it "
                "did would not happen again. Write the dataset with what recorded it"
            )
    write_candidates(
        part,
        (_as_candidate(recorded, simulator, video) for recorded in recordings),
        fps=round(simulator.control_hz),
        versions=versions,
        description="Driven by hand with `roborecover curate teleop`.",
    )


def _as_candidate(recorded: Recorded, simulator: Simulator, video: VideoSettings) -> Recording:
    count, mark = len(recorded.actions), recorded.mark
    error_m, solved = _replay(recorded, simulator)
    differs = np.flatnonzero(solved != recorded.solved)
    # What it lacks is asked of its numbers once more: earlier versions looked for less.
    lacks = lacking(None if mark is None else mark[0], recorded.solved, recorded.task.horizon)
    reason, detail = lacks, ""
    if len(differs):
        reason = "does not replay"
        detail = f"{'solved' if solved[differs[0]] else 'not solved'} after {differs[0]} steps of the replay"
    if error_m > HANDOFF_TOLERANCE_M:
        reason = "does not replay"
        detail = f"{error_m * 1000:.3g} mm off; the limit is {HANDOFF_TOLERANCE_M * 1000:g}"
    suggestions = ()
    if mark is not None and mark[0] < count:
        suggestions = (Suggestion(mark[0], "marked while driving", "operator", mark[1], mark[2]),)
    return Recording(
        Candidate(recorded.id, Source.HUMAN, recorded.source_record, suggestions),
        Trajectory(
            task=recorded.task,
            driver=recorded.operator,
            actions=recorded.actions,
            frames=_frames(recorded, simulator, video.every),
            # With a recovery point: whether it was recovered from. Without one: as the rollout ended.
            success=bool(recorded.solved[-1]) if mark is None else not lacks,
            reset=recorded.reset,
            provenance={"teleop": {**recorded.notes, "film": video.note()}},
        ),
        Steps(recorded.bodies, recorded.solved, np.full(count, UNPERTURBED, np.int8)),
        exclusion=reason,
        exclusion_detail=detail,
        excluded_by="teleop" if reason else "",
    )


def _replay(recorded: Recorded, simulator: Simulator) -> tuple[float, np.ndarray]:
    """A replay's largest displacement of any body at any step, metres; and its predicate, (T + 1,) bool."""
    largest, solved = 0.0, np.zeros(len(recorded.actions) + 1, bool)
    for step in iter_steps(simulator, recorded.rollout):
        solved[step] = simulator.succeeded()
        now = simulator.bodies()  # of a later version: it may mark more than was recorded
        for name, poses in recorded.bodies.items():
            gap = np.linalg.norm(np.subtract(now[name].position_m, poses[step, :3]))
            largest = max(largest, float(gap))
    return largest, solved


def _frames(
    recorded: Recorded, simulator: Simulator, frame_stride: int
) -> Iterator[Mapping[str, np.ndarray]]:
    from lerobot_roborecover.datasets.episodes import to_frame

    frame: Mapping[str, np.ndarray] = {}
    for step in iter_steps(simulator, recorded.rollout, len(recorded.actions) - 1):
        if step % frame_stride == 0:
            frame = to_frame(recorded.task.platform, simulator.observe())
        yield frame


def _join(dataset: Path, parts: list[Path]) -> None:
    with atomic_dir(dataset, replace=True) as folder:
        merge_candidates(folder, parts)
