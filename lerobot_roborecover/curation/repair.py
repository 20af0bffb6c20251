"""Repairs a dataset that LeRobot's tools have edited, with all that building scenarios knows of it.

`datasets/repair.py` finds each episode again by its exact actions and rebuilds scenarios or trajectories.
Here what hangs on them follows: the candidates with their steps, the decisions so far, and the votes. All of
it goes by candidate id, and is brought to name the episodes that are there: each once, and no others.
Nothing is taken away from the sources.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from lerobot_roborecover.curation.annotation.carried import copy_examples, gather_votes, write_votes
from lerobot_roborecover.curation.annotation.votes import VOTES_FOLDER
from lerobot_roborecover.curation.candidates import (
    CANDIDATES_FILE,
    Candidate,
    CandidateSet,
    check_candidates,
    read_candidates,
)
from lerobot_roborecover.curation.candidates_write import check_joinable, write_candidate_metadata
from lerobot_roborecover.curation.funnel import (
    DECISIONS_FILE,
    Decision,
    read_decisions,
    record_decisions,
)
from lerobot_roborecover.datasets.files import FolderUpdate, update_folder
from lerobot_roborecover.datasets.load import load_scenarios
from lerobot_roborecover.datasets.repair import Repaired, read_edited, repair
from lerobot_roborecover.datasets.schema import FOLDER
from lerobot_roborecover.datasets.trajectories import TrajectoryRow, actions_sha256
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.utils.text import pluralize


def repair_dataset(
    root: str | os.PathLike[str], sources: Sequence[str], *, dry_run: bool = False
) -> Repaired:
    """Rebuilds `meta/roborecover/` of a dataset: of scenarios, of trajectories, or of candidates.

    Args:
        root: the dataset that a tool has made.
        sources: the datasets it was made from: folders, or for scenarios also Hub ids.
        dry_run: find out and check, and change nothing.

    Raises:
        ScenarioError: names what cannot be brought into agreement; nothing is changed then.
    """
    root, folders = Path(root), [Path(s) for s in sources]
    kinds = {(folder / FOLDER / CANDIDATES_FILE).is_file() for folder in folders}
    if len(kinds) > 1:
        raise ScenarioError(
            "some sources are candidate datasets and some are not; repair needs one kind. Name those that "
            "the episodes came from"
        )
    if True in kinds:
        return _repair_candidates(root, [read_candidates(f, videos=False) for f in folders], dry_run)
    known = [f for f in folders if f.is_dir()]
    decisions = [read_decisions(f) for f in known]
    repaired = repair(root, sources, dry_run=True)
    lines: list[str] = []
    there = set(repaired.ids)
    if any(decisions) and there:
        gone = {s.id for f in known for s in load_scenarios(str(f))} - there
        kept = _decisions(root, decisions, gone)
        lines = [_decisions_line(kept, gone)]
    if not dry_run:
        with update_folder(root) as update:
            repaired = repair(root, sources, update=update)
            if lines:
                _write_decisions(update, kept)
    return replace(repaired, lines=(*repaired.lines, *lines))


def _repair_candidates(root: Path, sets: Sequence[CandidateSet], dry_run: bool) -> Repaired:
    """A dataset of candidates, from its sources."""
    check_joinable(sets)
    episodes = read_edited(root, [str(s.root) for s in sets])
    origins = [_origin(n, actions_sha256(actions), sets) for n, (actions, _) in enumerate(episodes)]
    candidates = [found.candidates[episode] for found, episode in origins]
    rows = [found.row(episode) for found, episode in origins]
    check_candidates(str(root), candidates, rows)
    for found, episode in origins:
        found.steps(episode)
    there = {c.id for c in candidates}
    gone = {c.id for s in sets for c in s.candidates} - there
    folders = [s.root for s in sets]
    decisions = _decisions(root, [read_decisions(f) for f in folders], gone)
    votes = gather_votes(folders, root, there)
    lines = [
        _decisions_line(decisions, gone),
        f"{VOTES_FOLDER}: {pluralize(sum(map(len, votes.values())), 'record')} of "
        f"{pluralize(len(votes), 'annotator')}; votes that are "
        "kept elsewhere (--votes FOLDER) go by candidate id and need no repair",
    ]
    lines = [f"{CANDIDATES_FILE} and steps.parquet: {pluralize(len(candidates), 'candidate')}", *lines]
    names = [str(f) for f in folders]
    if dry_run:
        done = repair(root, names, dry_run=True)
    else:
        with update_folder(root) as update:
            done = repair(root, names, update=update)
            steps = (found.steps(episode) for found, episode in origins)
            write_candidate_metadata(update.folder, candidates, steps, sets[0].versions)
            _write_decisions(update, decisions)
            write_votes(root, votes, update.folder)
            copy_examples(folders, root, update.folder)
        whole = read_candidates(root)
        for episode in range(len(whole)):
            whole.actions(episode)
            whole.steps(episode)
    return replace(done, lines=(*done.lines, *lines))


def _origin(number: int, sha256: str, sets: Sequence[CandidateSet]) -> tuple[CandidateSet, int]:
    """Where an episode comes from, by its exact actions; the same candidate in two sources is one.

    Raises:
        ScenarioError: no source has it, or several different candidates have these actions.
    """
    found: dict[tuple[Candidate, str], tuple[CandidateSet, int]] = {}
    for candidates in sets:
        for episode, row in enumerate(candidates.trajectories.rows):
            if row.actions_sha256 == sha256:
                found.setdefault((candidates.candidates[episode], _plain(row)), (candidates, episode))
    if len(found) != 1:
        names = ", ".join(c.id for c, _ in found)[:200]
        raise ScenarioError(
            f"episode {number}: {len(found)} candidates of the sources have these actions"
            + (f" ({names}); not distinguishable. Remove all but one" if found else "")
            + ("" if found else ". Name every dataset that it came from")
        )
    return next(iter(found.values()))


def _plain(row: TrajectoryRow) -> str:
    return repr({**asdict(row), "scenario_index": 0})


def _decisions(root: Path, sources: Iterable[Sequence[Decision]], gone: set[str]) -> list[Decision]:
    """All decisions in the order in which they were made, each once, without those on candidates that are
    not here: the sources still have them. Decisions on rollouts that never became candidates stay.

    Raises:
        ScenarioError: the dataset itself has decisions that would be lost.
    """
    known = list(dict.fromkeys(d for decisions in sources for d in decisions))
    own = read_decisions(root)
    for lost in set(own) - set(known):
        if lost.candidate in gone:
            raise ScenarioError(
                f"{root}: {DECISIONS_FILE} has a decision of {lost.stage} on {lost.candidate}, whose episode "
                "is not here, that is in no source. Name the dataset that has it, or move the file away"
            )
    kept = dict.fromkeys(d for d in (*known, *own) if d.candidate not in gone)
    return sorted(kept, key=lambda d: d.at)


def _decisions_line(decisions: Sequence[Decision], gone: set[str]) -> str:
    on = len({d.candidate for d in decisions})
    return (
        f"{DECISIONS_FILE}: {pluralize(len(decisions), 'decision')} on {pluralize(on, 'rollout')}; "
        f"{pluralize(len(gone), 'candidate')} of the sources not "
        "in this dataset"
    )


def _write_decisions(update: FolderUpdate, decisions: Sequence[Decision]) -> None:
    """Puts the journal in the place of what was there, which is a part of it."""
    if decisions and read_decisions(update.root) != list(decisions):
        record_decisions(update.folder, decisions)
