"""Which dataset and which episode a vote is about, in words that tell an annotator nothing.

Candidates' ids name the controller and what was perturbed, and a folder's name often does, too. What
annotators see, in the page, its address, the browser's storage and on the wire, are hashes: the same at every
start, mapped back here.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from lerobot_roborecover.curation.candidates import CandidateSet

DIGITS = 12
"""Hexadecimal digits of an episode's name; more only where two would be equal."""
DATASET_DIGITS = 16


@dataclass(frozen=True)
class Names:
    """What annotators call a dataset and its episodes."""

    dataset: str
    """See `dataset_name`."""
    episodes: Mapping[str, str]
    """Name by candidate id."""
    candidates: Mapping[str, str]
    """Candidate id by name."""


def names_of(candidates: CandidateSet, votes: Path) -> Names:
    """The names of a dataset and of its episodes.

    Args:
        candidates: the dataset.
        votes: folder of its votes.
    """
    prints = {c.id: _rollout_sha256(candidates, number) for number, c in enumerate(candidates.candidates)}
    digits = DIGITS
    while len({p[:digits] for p in prints.values()}) < len(prints):
        digits += 1
    episodes = {candidate: p[:digits] for candidate, p in prints.items()}
    return Names(
        dataset_name(candidates, votes), episodes, {name: candidate for candidate, name in episodes.items()}
    )


def dataset_name(candidates: CandidateSet, votes: Path) -> str:
    """Which votes these are: of one folder, on a dataset that begins with one rollout.

    A copy elsewhere is another dataset, since its votes are others. One that grows (`teleop`, `collect`)
    stays the same: only its first rollout counts. Where a folder was filled anew and begins alike, the
    episodes' names still tell the rollouts apart.
    """
    first = _rollout_sha256(candidates, 0) if candidates.candidates else ""
    return _sha256(["roborecover annotate", str(votes.resolve()), first])[:DATASET_DIGITS]


def _rollout_sha256(candidates: CandidateSet, episode: int) -> str:
    """Of one rollout: the candidate's id and what was executed from where, so that a vote can only reach an
    episode that shows what was voted on."""
    row = candidates.row(episode)
    reset = None if row.reset is None else dict(row.reset)
    return _sha256([candidates.candidates[episode].id, row.actions_sha256, dict(row.task), reset])


def _sha256(parts: list) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def queue_order(candidates: Iterable[str], annotator: str, seed: int) -> list[str]:
    """Candidates in an annotator's order.

    A candidate's place depends on its own id alone, so that candidates which come or go later leave the order
    of the others as it was.

    Args:
        candidates: ids.
        annotator: whose order.
        seed: of the study.
    """
    return sorted(candidates, key=lambda c: hashlib.sha256(f"{seed}/{annotator}/{c}".encode()).digest())
