"""Candidate datasets: whole rollouts from which scenarios are built, and all that is known of each.

A candidate dataset is a trajectory dataset of kind `rollouts` (`datasets/trajectories.py`): video, exact
float64 actions, task, reset, controller. Beside that, in `meta/roborecover/`:

- `candidates.json`: one entry an episode, in the order of the episodes: id, source, suggestions; and the
  versions of the simulator that recorded them;
- `steps.parquet`: one row an episode: body poses and the task's predicate before the first action and after
  each, and where an action was perturbed;
- `decisions.jsonl`: what each stage decided (`curation/funnel.py`);
- `votes/NAME.jsonl`: what each annotator marked (`curation/annotation/votes.py`).

What comes from a file is checked here and trusted afterwards.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_roborecover.datasets.files import load_json, read_bytes, what_it_is
from lerobot_roborecover.datasets.parquet_read import number_array, open_parquet, read_frames
from lerobot_roborecover.datasets.schema import FOLDER, MAX_BODIES
from lerobot_roborecover.datasets.trajectories import (
    TrajectoryRow,
    TrajectorySet,
    actions_sha256,
    read_trajectories,
)
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.scenario import (
    ID_RULE,
    DeviationType,
    Fingerprint,
    Scenario,
    ScenarioError,
    Source,
    Stage,
    is_id,
    shown_id,
)

CANDIDATES_FILE = "candidates.json"
STEPS_FILE = "steps.parquet"
SCHEMA_VERSION = 1
MAX_CANDIDATES_BYTES = 2**26
MAX_SUGGESTIONS = 100

STEPS_SCHEMA = pa.schema(
    [
        pa.field("episode_index", pa.int64(), nullable=False),
        pa.field("bodies", pa.list_(pa.string()), nullable=False),
        pa.field("poses", pa.list_(pa.float64()), nullable=False),
        pa.field("solved", pa.list_(pa.bool_()), nullable=False),
        pa.field("perturbation", pa.list_(pa.int8()), nullable=False),
    ],
)
"""`poses` is (bodies, T + 1, 7): position in metres and quaternion xyzw, row-major."""


@dataclass(frozen=True)
class Suggestion:
    """A recovery point that a program or an operator proposes; only people's votes count."""

    step: int
    reason: str
    by: str
    """The rule, the model, or `operator` for the person at the controls."""
    stage: str = ""
    """A `Stage`, or empty."""
    deviation: str = ""
    """A `DeviationType`, or empty."""


@dataclass(frozen=True)
class Candidate:
    """Facts that make a rollout a candidate."""

    id: str
    """Unique in its dataset; becomes the scenario's id."""
    source: Source
    source_record: str = ""
    """What it was recorded from where that is not the rollout itself, e.g. a demonstration's file: candidates
    that share it stay in one split."""
    suggestions: tuple[Suggestion, ...] = ()

    def __post_init__(self):
        if not is_id(self.id):
            raise ScenarioError(f"candidate id {shown_id(self.id)} is not {ID_RULE}")
        try:
            object.__setattr__(self, "source", Source(self.source))
        except ValueError:
            raise ScenarioError(
                f"candidate {self.id}: source {self.source!r:.80} is not one of {[s.value for s in Source]}"
            ) from None
        if not isinstance(self.source_record, str) or len(self.source_record) > 1000:
            raise ScenarioError(f"candidate {self.id}: source_record is not text of at most 1000 characters")
        if len(self.suggestions) > MAX_SUGGESTIONS:
            raise ScenarioError(
                f"candidate {self.id}: {len(self.suggestions)} suggestions; the limit is {MAX_SUGGESTIONS}"
            )
        for s in self.suggestions:
            texts = isinstance(s.reason, str) and isinstance(s.by, str) and len(s.reason + s.by) <= 1000
            labels = s.stage in ("", *Stage) and s.deviation in ("", *DeviationType)
            if type(s.step) is not int or s.step < 0 or not texts or not labels:
                raise ScenarioError(f"candidate {self.id}: {s!r:.200} is not a suggestion")


@dataclass(frozen=True)
class CandidateSet:
    """A candidate dataset as it was read."""

    root: Path
    trajectories: TrajectorySet
    candidates: tuple[Candidate, ...]
    """Candidates by episode."""
    versions: Mapping[str, str]
    """Versions of the simulator that recorded, as `Simulator.fingerprint` names them."""

    def __len__(self) -> int:
        return len(self.candidates)

    @property
    def platform(self) -> str:
        """Platform of all candidates."""
        return self.trajectories.platform

    def row(self, episode: int) -> TrajectoryRow:
        """Returns the stored row of an episode's rollout."""
        return self.trajectories.rows[episode]

    @cached_property
    def by_id(self) -> dict[str, int]:
        """Episode by candidate id."""
        return {c.id: i for i, c in enumerate(self.candidates)}

    @cached_property
    def _actions(self) -> list[np.ndarray]:
        return exact_actions(self.root)

    def actions(self, episode: int) -> np.ndarray:
        """The rollout's exact (T, A) float64 actions.

        Raises:
            ScenarioError: the data does not hold the actions that were recorded.
        """
        row = self.row(episode)
        found = self._actions[episode] if episode < len(self._actions) else np.zeros((0, 0))
        if actions_sha256(found) != row.actions_sha256:
            raise ScenarioError(
                f"{self.root}: the actions of episode {episode} ({self.candidates[episode].id}) are not "
                "those that were recorded. Fetch the dataset again"
            )
        return found

    def steps(self, episode: int) -> Steps:
        """The rollout step by step.

        Raises:
            ScenarioError: the file's row is not what `write_candidates` writes.
        """
        path, count = self.root / FOLDER / STEPS_FILE, self.row(episode).steps
        try:
            with pq.ParquetFile(self._steps_path) as file:
                table = file.read_row_group(episode, columns=STEPS_SCHEMA.names)
            names = table["bodies"].combine_chunks().flatten()
            if len(table) != 1 or len(names) > MAX_BODIES:
                raise ValueError(f"{len(table)} rows, {len(names)} bodies; the limit is {MAX_BODIES}")
            bodies = names.to_pylist()
            number, poses, solved, perturbation = (
                number_array(table[name])[0] for name in STEPS_SCHEMA.names if name != "bodies"
            )
            poses = poses.astype(np.float64).reshape(len(bodies), count + 1, 7)
            solved, perturbation = solved.astype(bool), perturbation.astype(np.int8)
            if number != episode or solved.shape != (count + 1,):
                raise ValueError("of another episode")
            if perturbation.shape != (count,) or not np.isfinite(poses).all():
                raise ValueError("of another length, or not finite")
        except (OSError, ValueError, IndexError, KeyError, TypeError, pa.ArrowException) as err:
            raise ScenarioError(
                f"{path}: row {episode} is not what write_candidates writes ({err!s:.200}). Fetch or write "
                "the dataset again"
            ) from None
        return Steps(dict(zip(bodies, poses, strict=True)), solved, perturbation)

    @cached_property
    def _steps_path(self) -> Path:
        """The file of `steps`, once its decoded size is known to be bounded."""
        path = self.root / FOLDER / STEPS_FILE
        with open_parquet(path):
            return path

    def scenario(
        self, candidate_id: str, step: int, stage: Stage, deviation: DeviationType, provenance: dict[str, Any]
    ) -> Scenario:
        """The scenario whose recovery point is a step of a candidate's rollout.

        Its fingerprint holds the poses that were recorded, so that the first replay is already checked
        against the rollout itself.

        Raises:
            ScenarioError: the step is not inside the rollout.
        """
        episode = self.by_id[candidate_id]
        row, candidate = self.row(episode), self.candidates[episode]
        reset = row.reset_record()
        if reset is None or not reset.settle_steps < step < row.steps:
            raise ScenarioError(f"candidate {candidate_id}: no recovery point can be at step {step}")
        notes = {"rollout": {"dataset": self.root.name, "episode": episode, "steps": row.steps}}
        if candidate.source_record:
            notes["source_record"] = candidate.source_record
        return Scenario(
            id=candidate.id,
            task=row.task_record(),
            reset=reset,
            prefix=self.actions(episode)[:step],
            stage=stage,
            deviation=deviation,
            source=candidate.source,
            source_policy=row.driver,
            cluster=candidate.id,
            provenance={**dict(row.provenance), **notes, **provenance},
            fingerprint=Fingerprint(step, self.steps(episode).poses_at(step), "", self.versions),
        )


def _candidate(fields: Mapping[str, Any], suggestions: tuple[Suggestion, ...]) -> Candidate:
    whole: dict[str, Any] = {**fields, "suggestions": suggestions}
    return Candidate(**whole)


def read_candidates(root: str | os.PathLike[str], *, videos: bool = True) -> CandidateSet:
    """Reads and checks a candidate dataset's own metadata; trusts nothing in it.

    Args:
        root: the dataset's folder.
        videos: refuse one whose videos have another number of frames than steps.

    Raises:
        ScenarioError: names the file and the field.
    """
    root = Path(root)
    path = root / FOLDER / CANDIDATES_FILE
    if not path.exists():
        raise ScenarioError(
            f"{root} is not a candidate dataset: {FOLDER}/{CANDIDATES_FILE} is missing. Make one with "
            "write_candidates from recorded rollouts"
        )
    data = read_bytes(root, path, MAX_CANDIDATES_BYTES)
    trajectories = read_trajectories(root, videos=videos)
    try:
        found = load_json(data)
        if found["schema_version"] > SCHEMA_VERSION:
            raise ScenarioError(
                f"field schema_version: {found['schema_version']} is from the future; upgrade this package: "
                "pip install -U lerobot_env_roborecover"
            )
        candidates = tuple(
            _candidate(c, tuple(Suggestion(**s) for s in c["suggestions"])) for c in found["candidates"]
        )
        versions = {str(k): str(v) for k, v in found["versions"].items()}
    except ScenarioError as err:
        raise ScenarioError(f"{path}: {err}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        raise ScenarioError(
            f"{path} is not what write_candidates writes ({err!r:.200}): {what_it_is(data)}"
        ) from None
    check_candidates(str(path), candidates, trajectories.rows)
    return CandidateSet(root, trajectories, candidates, versions)


def check_candidates(where: str, candidates: Sequence[Candidate], rows: Sequence[TrajectoryRow]) -> None:
    """Checks what candidates need beyond their own validity.

    Raises:
        ScenarioError: an id occurs twice, there is not one candidate an episode, or a rollout cannot be
            replayed.
    """
    if len(candidates) != len(rows):
        raise ScenarioError(f"{where}: {len(candidates)} candidates, but {len(rows)} rollouts; one is of one")
    seen: dict[str, int] = {}
    for number, (candidate, row) in enumerate(zip(candidates, rows, strict=True)):
        if seen.setdefault(candidate.id, number) != number:
            raise ScenarioError(
                f"{where}: candidate {number} has the id of candidate {seen[candidate.id]}, "
                f"{candidate.id!r}; ids are unique. Rename one"
            )
        if row.reset is None or row.not_replayable:
            raise ScenarioError(
                f"{where}: candidate {candidate.id} cannot be replayed "
                f"({row.not_replayable or 'it has no reset'}); a scenario is rebuilt by replay. Leave it out"
            )
        late = [s.step for s in candidate.suggestions if s.step >= row.steps]
        if late:
            raise ScenarioError(
                f"{where}: candidate {candidate.id} suggests step {late[0]}; its frames are 0 to "
                f"{row.steps - 1}"
            )


def exact_actions(root: Path) -> list[np.ndarray]:
    """Exact (T, A) float64 actions of every episode, by its number; much faster than row by row.

    Raises:
        ScenarioError: the data lacks the column, or an episode's frames.
    """
    from lerobot_roborecover.datasets.episodes import EXACT_ACTION

    found = read_frames(root, (EXACT_ACTION,))
    for number in range(len(found)):
        if number not in found:
            raise ScenarioError(f"{root}/data holds no frames of episode {number}; fetch the dataset again")
    return [found[number][EXACT_ACTION].astype(np.float64, copy=False) for number in range(len(found))]
