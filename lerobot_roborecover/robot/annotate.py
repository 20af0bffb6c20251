"""Several raters mark a robot's recovery points on the annotation page, each alone and blind.

The page shows candidate datasets (`curation/candidates.py`), so the episodes are written as one, once, beside
the points. A robot tells no poses of objects: what the page plots are the commanded joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lerobot_roborecover.curation.agreement import format_agreement
from lerobot_roborecover.curation.annotation.votes import votes_folder
from lerobot_roborecover.curation.candidates import Candidate, CandidateSet, Suggestion, read_candidates
from lerobot_roborecover.curation.candidates_write import Recording, write_candidates
from lerobot_roborecover.curation.resolution import ResolutionConfig, resolve
from lerobot_roborecover.datasets.trajectory_write import Trajectory
from lerobot_roborecover.replay.recorder import Steps
from lerobot_roborecover.robot.episodes import Episodes, PointRequest, plain_name
from lerobot_roborecover.robot.options import RobotPointsOptions
from lerobot_roborecover.robot.points import CAMERA_PREFIX, PLATFORM
from lerobot_roborecover.robot.recorder import marks
from lerobot_roborecover.scenario import Reset, ScenarioError, Source, Task


def candidates_folder(options: RobotPointsOptions) -> Path:
    """Where the candidate dataset of an annotation lies, with its votes."""
    return options.out.with_name(f"{options.out.name}.candidates")


def annotate(options: RobotPointsOptions, say: Callable[[str], None]) -> None:
    """Serves the annotation page until it is interrupted.

    Args:
        options: the dataset, and who annotates.
        say: takes lines.

    Raises:
        ScenarioError: the dataset cannot be used, or the port is taken.
    """
    from lerobot_roborecover.web.annotate.serve import AnnotateConfig, serve

    folder = candidates_folder(options)
    if not folder.exists():
        say(f"writing the episodes for the page: {folder}")
        write_episodes(options.dataset, folder, options.source_policy)
    try:
        serve(AnnotateConfig(folder, options.annotators, options.port, examples=False), say)
    except KeyboardInterrupt:  # every vote is on disk already
        say(f"stopped; then: roborecover robot points {options.dataset} --out {options.out} --votes-needed N")


def write_episodes(dataset: Path, folder: Path, driver: str = "") -> None:
    """Writes a robot's episodes as a candidate dataset; what was marked at the robot is a suggestion.

    Args:
        dataset: a LeRobotDataset of a robot.
        folder: new.
        driver: who drove.

    Raises:
        ScenarioError: the dataset cannot be used.
    """
    episodes = Episodes(dataset)

    def recordings() -> Iterator[Recording]:
        for episode in range(len(episodes)):
            if episodes.steps(episode) > 1:
                yield _recording(episodes, episode, driver)

    write_candidates(
        folder, recordings(), fps=round(episodes.fps), versions={"robot": episodes.notes.robot_type}
    )


def _recording(episodes: Episodes, episode: int, driver: str) -> Recording:
    steps, name = episodes.steps(episode), _candidate_id(episodes, episode)
    instruction = episodes.instruction(episode)
    found = tuple(
        Suggestion(m["frame"], "marked while the policy ran", str(m["by"]))
        for m in marks(episodes.root)
        if m["episode"] == episode and m["frame"] < steps
    )

    def frames() -> Iterator[dict[str, np.ndarray]]:
        for step in range(steps):
            pictures = episodes.pictures(episode, [step])
            yield {CAMERA_PREFIX + camera: stack[0] for camera, stack in pictures.items()}

    nowhere = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (steps + 1, 1))
    trajectory = Trajectory(
        task=Task(
            PLATFORM, episodes.notes.robot_type, plain_name(instruction)[:80], instruction, max(steps, 1)
        ),
        driver=driver or "policy",
        actions=episodes.columns(episode, "action"),
        frames=frames(),
        success=False,
        reset=Reset(options={"episode": episode}),
    )
    states = Steps({"eef": nowhere}, np.zeros(steps + 1, bool), np.zeros(steps, np.int8))
    return Recording(Candidate(name, Source.NATURAL, suggestions=found), trajectory, states)


def _candidate_id(episodes: Episodes, episode: int) -> str:
    return f"{plain_name(episodes.root.name)}-e{episode:04d}"


def voted(options: RobotPointsOptions, say: Callable[[str], None]) -> list[PointRequest]:
    """The recovery points on which raters agree.

    Args:
        options: the dataset, and how many votes each episode needs.
        say: takes lines: agreement, and what became of the episodes.

    Raises:
        ScenarioError: there are no votes, or no episode has a consensus.
    """
    folder = candidates_folder(options)
    candidates = read_candidates(folder)
    config = ResolutionConfig(annotators=options.votes_needed or 1)
    found = resolve(candidates, votes_folder(folder, None), config)
    say(format_agreement(found.agreement))
    say(", ".join(f"{n} {outcome}" for outcome, n in sorted(found.counts().items())))
    kept = [r for r in found.candidates if r.outcome == "kept"]
    if not kept:
        raise ScenarioError(f"no episode has {config.annotators} votes that agree yet: {found.counts()}")
    return [
        PointRequest(
            episode=_episode(candidates, r.candidate),
            frame=r.step or 0,
            stage=r.stage,
            deviation=r.deviation,
            source_policy=options.source_policy,
            quasi_static=True,  # raters discard what is not at rest
            votes=[asdict(v) for v in r.votes],
        )
        for r in kept
    ]


def _episode(candidates: CandidateSet, candidate: str) -> int:
    """The dataset's episode that a candidate was written from."""
    reset = candidates.row(candidates.by_id[candidate]).reset_record()
    if reset is None or not isinstance(reset.options.get("episode"), int):
        raise ScenarioError(
            f"{candidates.root}: candidate {candidate} does not say its episode; write it anew"
        )
    return reset.options["episode"]
