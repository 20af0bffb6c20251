"""Writes candidate datasets, and joins those of several runs, so that a stopped collection goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover._version import __version__
from lerobot_roborecover.curation.annotation.carried import copy_examples, gather_votes, write_votes
from lerobot_roborecover.curation.candidates import (
    CANDIDATES_FILE,
    MAX_CANDIDATES_BYTES,
    SCHEMA_VERSION,
    STEPS_FILE,
    STEPS_SCHEMA,
    Candidate,
    CandidateSet,
    check_candidates,
    read_candidates,
)
from lerobot_roborecover.curation.funnel import Decision, read_decisions, record_decisions
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectories import read_trajectories
from lerobot_roborecover.datasets.trajectory_write import Trajectory, write_metadata, write_trajectories
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.atomic_io import atomic_dir, atomic_file, atomic_write


@dataclass(frozen=True)
class Recording:
    """One rollout to be written as a candidate."""

    candidate: Candidate
    trajectory: Trajectory
    """With its reset; frames are those that a policy saw, one before each action."""
    steps: Steps
    exclusion: str = ""
    """Why a rule would leave it out, in a few words; empty where none does. A person may take that back."""
    exclusion_detail: str = ""
    """The values behind it."""
    excluded_by: str = ""
    """The rule's name."""


def write_candidates(
    root: str | os.PathLike[str],
    recordings: Iterable[Recording],
    *,
    fps: int,
    versions: Mapping[str, str],
    description: str = "",
    license: str | None = None,
) -> Path:
    """Writes a candidate dataset; it appears as a whole, or not at all.

    Args:
        root: the dataset's folder; must be new or empty.
        recordings: of one platform; drawn one at a time.
        fps: frame rate: the platform's control rate.
        versions: of the simulator that recorded (`Simulator.fingerprint`).
        description: free text.
        license: SPDX identifier, or None where none is decided.

    Raises:
        ScenarioError: a recording is not whole or not replayable, or an id occurs twice.
    """
    root = Path(root)
    kept: list[Recording] = []

    def draw() -> Iterable[Trajectory]:
        for recording in recordings:
            _check_steps(recording)
            yield recording.trajectory
            kept.append(recording)

    with atomic_dir(root) as folder:
        write_trajectories(folder, "rollouts", draw(), fps=fps, description=description, license=license)
        candidates = [r.candidate for r in kept]
        check_candidates(str(root), candidates, read_trajectories(folder).rows)
        write_candidate_metadata(folder, candidates, [r.steps for r in kept], versions)
        record_decisions(folder, (_collected(r) for r in kept))
    return root


def merge_candidates(root: str | os.PathLike[str], sources: Sequence[Path]) -> Path:
    """Joins candidate datasets of one platform without encoding anything again; sources stay as they are.

    Decisions, votes and example pictures come along.

    Args:
        root: the dataset's folder; must be new or empty.
        sources: in the order in which their episodes follow each other.

    Raises:
        ScenarioError: platforms, versions or features differ, an id occurs twice, or votes contradict each
            other.
    """
    from lerobot_roborecover.datasets.encoding import join_datasets

    root, sets = Path(root), [read_candidates(s) for s in sources]
    check_joinable(sets)
    manifests = [s.trajectories.manifest for s in sets]
    licenses = {m.get("license") for m in manifests}

    candidates = [c for s in sets for c in s.candidates]
    rows = [r for s in sets for r in s.trajectories.rows]
    folders = [s.root for s in sets]
    votes = gather_votes(folders, root, {c.id for c in candidates})
    with atomic_dir(root) as folder:
        join_datasets(folder, folders, [row.steps for row in rows])
        check_candidates(str(root), candidates, rows)
        write_metadata(
            folder,
            "rollouts",
            [],
            rows,
            description=" ".join(dict.fromkeys(m.get("description", "") for m in manifests)).strip(),
            license=licenses.pop() if len(licenses) == 1 else None,
        )
        steps = (s.steps(episode) for s in sets for episode in range(len(s)))
        write_candidate_metadata(folder, candidates, steps, sets[0].versions)
        record_decisions(folder, (d for f in folders for d in read_decisions(f)))
        write_votes(folder, votes)
        copy_examples(folders, folder)
    return root


def check_joinable(sets: Sequence[CandidateSet]) -> None:
    """Checks that candidate datasets can be one.

    Raises:
        ScenarioError: there is none, or platforms or versions differ.
    """
    if not sets:
        raise ScenarioError("there are no candidate datasets to join")
    for found in sets[1:]:
        for label, one, other in (
            ("platform", found.platform, sets[0].platform),
            ("versions", found.versions, sets[0].versions),
        ):
            if one != other:
                raise ScenarioError(
                    f"{found.root} has {label} {one}, {sets[0].root} {other}; join only what one simulator "
                    "recorded"
                )


def write_candidate_metadata(
    root: Path, candidates: Sequence[Candidate], steps: Iterable[Steps], versions: Mapping[str, str]
) -> None:
    """Writes `candidates.json` and `steps.parquet` of a dataset whose episodes and rows are there."""
    folder = root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        "schema_version": SCHEMA_VERSION,
        "written_by": {"lerobot_env_roborecover": __version__},
        "versions": dict(versions),
        "candidates": [asdict(c) for c in candidates],
    }
    text = json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n"
    if len(text.encode()) > MAX_CANDIDATES_BYTES:
        raise ScenarioError(f"{CANDIDATES_FILE} would exceed {MAX_CANDIDATES_BYTES} bytes; split the dataset")
    # One row group an episode: a page reads one without decoding a thousand.
    with (
        atomic_file(folder / STEPS_FILE) as path,
        pq.ParquetWriter(path, STEPS_SCHEMA, compression="zstd") as writer,
    ):
        for episode, step in enumerate(steps):
            row = {
                "episode_index": episode,
                "bodies": list(step.bodies),
                "poses": np.stack(list(step.bodies.values())).ravel(),
                "solved": step.solved,
                "perturbation": step.perturbation,
            }
            columns = [pa.array([row[f.name]], f.type) for f in STEPS_SCHEMA]
            writer.write_table(pa.Table.from_arrays(columns, schema=STEPS_SCHEMA))
    atomic_write(folder / CANDIDATES_FILE, text)


def _check_steps(recording: Recording) -> None:
    steps, count, name = recording.steps, len(recording.trajectory.actions), recording.candidate.id
    shapes = {np.shape(p) for p in steps.bodies.values()}
    if shapes != {(count + 1, 7)} or not any(body.startswith("eef") for body in steps.bodies):
        raise ScenarioError(
            f"candidate {name}: body poses must be ({count + 1}, 7) each, with an end effector (a name that "
            f"starts with 'eef') among them; got {sorted(shapes)} of {sorted(steps.bodies)}"
        )
    if np.shape(steps.solved) != (count + 1,) or np.shape(steps.perturbation) != (count,):
        raise ScenarioError(
            f"candidate {name}: solved has {np.shape(steps.solved)} values and perturbation "
            f"{np.shape(steps.perturbation)}; {count} actions have {count + 1} and {count}"
        )


def _collected(recording: Recording) -> Decision:
    return Decision(
        recording.candidate.id,
        "collect",
        "dropped" if recording.exclusion else "kept",
        recording.exclusion,
        recording.exclusion_detail,
        recording.excluded_by,
    )
